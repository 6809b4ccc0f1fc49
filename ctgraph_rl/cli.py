"""The console script ``ctgraph-rl``: a first word chooses a command, settings alone start a run."""

from __future__ import annotations

import os
import sys
from difflib import get_close_matches

from ctgraph_rl.packages import command

COMMANDS = {
    "agents": "baselines.__main__",
    "compare": "ctgraph_rl.compare",
    "curricula": "curricula.__main__",
    "draw": "ctgraph_rl.visualize.draw",
    "export": "ctgraph_rl.log.export",
    "methods": "baselines.methods.__main__",
    "play": "ctgraph_rl.visualize.play",
    "report": "ctgraph_rl.report.__main__",
    "results": "ctgraph_rl.report.results",
}
"""Commands and the modules whose ``main`` they are; each is imported when it is called."""


def main() -> None:
    """``ctgraph-rl COMMAND ...`` for one of `COMMANDS`; anything else is for `ctgraph_rl.run`.

    Ends quietly where nobody reads its output any more, as in ``ctgraph-rl results | head``.
    """
    try:
        _call()
        if sys.stdout is not None:
            sys.stdout.flush()
    except BrokenPipeError:
        if _has_reader():
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left has nowhere to go
        sys.exit(1)


def _has_reader() -> bool:
    """Whether it was another pipe that broke than standard output's; an empty line there finds out."""
    try:
        print(flush=True)
    except BrokenPipeError:
        return False
    return True


def _call() -> None:
    """Go to what the first word names."""
    word = sys.argv[1] if len(sys.argv) > 1 else ""
    if word in COMMANDS:
        sys.argv = [f"ctgraph-rl {word}", *sys.argv[2:]]
        try:
            main = command(COMMANDS[word])
        except ValueError as error:
            sys.exit(f"error: {error}")
        main()
    elif word.isidentifier():  # settings have a sign: seed=1, ~logger, -m
        near = [f"; did you mean {match!r}?" for match in get_close_matches(word, COMMANDS, 1)]
        choices = f"Commands: {', '.join(COMMANDS)}; or settings of a run, such as seed=1"
        sys.exit(f"error: unknown command {word!r}{''.join(near)} {choices}")
    else:
        command("ctgraph_rl.run")()
