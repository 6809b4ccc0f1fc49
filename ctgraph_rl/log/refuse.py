"""How a command refuses what its user asked for."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager

from ctgraph_rl.log.escape import terminal_lines


@contextmanager
def refused_by(parser: argparse.ArgumentParser) -> Iterator[None]:
    """Turn an error of the user into the usage, one message and exit code 2.

    A broken pipe is no such error.
    """
    try:
        yield
    except BrokenPipeError:
        raise
    except (ValueError, OSError, ModuleNotFoundError) as error:
        parser.error(terminal_lines(error))
