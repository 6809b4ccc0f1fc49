"""How commands refuse what a user typed."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager

from ctgraph_rl.disk import in_words
from ctgraph_rl.log.escape import terminal_lines


@contextmanager
def refused_by(parser: argparse.ArgumentParser) -> Iterator[None]:
    """Turn a user's error, but no broken pipe, into one message and exit code 2."""
    try:
        yield
    except BrokenPipeError:
        raise
    except (ValueError, OSError, ModuleNotFoundError) as error:
        parser.exit(2, f"{parser.prog}: error: {terminal_lines(in_words(error))}\n")
