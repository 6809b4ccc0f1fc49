"""How commands end: with a message on what the user asked for, or quietly once their output has no reader."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from ctgraph_rl.log.escape import terminal_lines


@contextmanager
def refused_by(parser: argparse.ArgumentParser) -> Iterator[None]:
    """Turn an error of the user into one message and exit code 2.

    A broken pipe is no such error.
    """
    try:
        yield
    except BrokenPipeError:
        raise
    except (ValueError, OSError, ModuleNotFoundError) as error:
        parser.exit(2, f"{parser.prog}: error: {terminal_lines(error)}\n")


@contextmanager
def quiet_where_nobody_reads() -> Iterator[None]:
    """Exit with code 1 and without a word once standard output has no reader, as in ``ctgraph-rl results | head``."""
    try:
        yield
        if sys.stdout is not None:
            sys.stdout.flush()
    except BrokenPipeError:
        if _has_reader():
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left has nowhere to go
        sys.exit(1)


def _has_reader() -> bool:
    """Return whether it was another pipe that broke than standard output's; an empty line there finds out."""
    try:
        print(flush=True)
    except BrokenPipeError:
        return False
    return True
