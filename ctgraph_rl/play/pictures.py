"""The command ``ctgraph-rl draw``: a task as a figure, its images, a DOT file or a film of an episode."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from ctgraph_rl import parsers
from ctgraph_rl.checks import at_least_one, require
from ctgraph_rl.disk import write_named
from ctgraph_rl.draw.dot import to_dot
from ctgraph_rl.draw.image_figure import image_figure
from ctgraph_rl.draw.style import save_figure
from ctgraph_rl.draw.task_figure import task_figure
from ctgraph_rl.log.escape import refused_by, terminal_text
from ctgraph_rl.play.arguments import Selection, select
from ctgraph_rl.play.gif import save_gif


def main(argv: Sequence[str] | None = None) -> None:
    """The command line, ``ctgraph-rl draw``."""
    parser = parsers.draw()
    arguments = parser.parse_args(argv)
    if not (arguments.figure or arguments.dot or arguments.gif):
        parser.error("nothing to write: name a --figure, --dot or --gif")
    with refused_by(parser):
        _write(select(arguments), arguments)
        for path in filter(None, (arguments.figure, arguments.dot, arguments.gif)):
            print(f"written: {terminal_text(path)}", file=sys.stderr)  # the file itself may be standard output


def _write(selection: Selection, arguments: argparse.Namespace) -> None:
    film = arguments.gif is None or selection.policy is not None, "a film needs a policy: name a --policy or a --run"
    require(film, *at_least_one(dpi=arguments.dpi, episodes=arguments.episodes))
    if arguments.figure is not None:
        if arguments.show == "images":
            figure = image_figure(selection.task, arguments.seed)
        elif selection.policy is None:
            figure = task_figure(selection.task, ids=arguments.show == "ids")
        else:
            seen = selection.visits(arguments.episodes, arguments.seed, not arguments.sampled)
            figure = task_figure(selection.task, visits=seen.counts, policy=seen.actions)
        save_figure(figure, arguments.figure, arguments.dpi)
    if arguments.dot is not None:
        write_named(arguments.dot, to_dot(selection.task, selection.name))
    if arguments.gif is not None:
        save_gif(selection.player(arguments.seed, not arguments.sampled), arguments.gif)


if __name__ == "__main__":
    main()
