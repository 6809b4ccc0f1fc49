"""How commands end: with a message for the user, or quietly without a reader of their output."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from ctgraph_rl.log.escape import terminal_lines


@contextmanager
def refused_by(parser: argparse.ArgumentParser) -> Iterator[None]:
    """Turn a user's error, but no broken pipe, into one message and exit code 2."""
    try:
        yield
    except BrokenPipeError:
        raise
    except (ValueError, OSError, ModuleNotFoundError) as error:
        parser.exit(2, f"{parser.prog}: error: {terminal_lines(error)}\n")


@contextmanager
def quiet_where_nobody_reads() -> Iterator[None]:
    """Exit quietly with code 1 once standard output has no reader, as in ``ctgraph-rl results | head``."""
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
    try:
        print(flush=True)
    except BrokenPipeError:
        return False
    return True
