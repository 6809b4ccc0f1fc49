"""The pages of the command line: the help of every command, and every setting of a run."""

from __future__ import annotations

import contextlib
import io
import os
import re
import sys
from argparse import ArgumentParser, _SubParsersAction
from collections.abc import Iterator
from unittest import mock

from yaml_settings import escaped, first_comment, names_in, settings_of, table

from ctgraph_rl import cli

GROUPS = {
    "exchange": ("Exchanges", "`exchange=NAME` lets several learners share what they learn."),
    "logger": ("Loggers", "`logger=NAME` also sends measurements elsewhere."),
    "experiment": ("Experiments", "`ctgraph-rl -m experiment=NAME` runs a recorded comparison."),
}
"""Folders of ``conf`` whose files are shown on the page of settings; others have cards."""


class _Found(Exception):
    """Carries the parser of a command out of its ``main``."""


def command_pages() -> Iterator[tuple[str, str]]:
    """Yield the path and the text of each page, in Markdown."""
    parts = ["# Command line", "`ctgraph-rl` runs an agent on a curriculum; its first word may be another command."]
    for name in ("", *cli.COMMANDS):
        parts += [f"## `{f'ctgraph-rl {name}'.strip()}`", *_helps(name)]
    yield "commands.md", "\n\n".join(parts) + "\n"
    yield "settings.md", _settings()


def _helps(name: str) -> Iterator[str]:
    """Yield the help of a command and of its own commands, as code blocks."""
    parser = None if name in ("", "run") else _parser(name)
    if parser is None:
        yield _block(_printed([*name.split(), "--help"]))
        return
    yield _block(parser.format_help())
    prog = parser.prog.replace("python -m curricula", "ctgraph-rl curricula")
    for action in parser._actions:
        if isinstance(action, _SubParsersAction):
            for word, each in action.choices.items():
                yield f"### `{prog} {word}`\n\n{_block(each.format_help())}"


def _parser(name: str) -> ArgumentParser | None:
    """Return the parser with which a command reads its arguments."""

    def find(self: ArgumentParser, *args: object, **kwargs: object) -> None:
        raise _Found(self)

    methods = dict.fromkeys(("parse_args", "parse_known_args", "parse_intermixed_args"), find)
    with mock.patch.multiple(ArgumentParser, **methods), mock.patch.object(sys, "argv", ["ctgraph-rl", name]), narrow():
        try:
            cli.main()
        except _Found as found:
            return found.args[0]
    return None


def _printed(words: list[str]) -> str:
    """Return what a command prints."""
    with narrow(), mock.patch.object(sys, "argv", ["ctgraph-rl", *words]), io.StringIO() as out:
        with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
            cli.main()
        return out.getvalue()


@contextlib.contextmanager
def narrow() -> Iterator[None]:
    """Let help be as wide as a page, without colours, whatever the terminal of the build is."""
    with mock.patch.dict(os.environ, {"COLUMNS": "96", "NO_COLOR": "1", "TERM": "dumb"}):
        yield


def _block(text: str) -> str:
    plain = re.sub(r"\x1b\[[0-9;]*m", "", text).strip()
    return f"```text\n{plain}\n```"


def _settings() -> str:
    """Return the page of settings: those of every run, then those of groups without cards."""
    parts = [
        "# Settings",
        "Every setting of a run, with its default. `KEY=VALUE` on the command line changes one. Those of "
        "[agents](agents/index.md) (`agent.KEY`), [methods](methods/index.md) (`method.KEY`) and "
        "[curricula](curricula/index.md) (`curriculum.KEY`) are on their cards.",
        table([setting for setting in settings_of("config") if not setting.key.startswith("hydra.")]),
    ]
    for group, (title, words) in GROUPS.items():
        parts += [f"## {title}", words, *(_file(group, name) for name in names_in(group))]
    return "\n\n".join(parts) + "\n"


def _file(group: str, name: str) -> str:
    comment = escaped(first_comment(f"{group}/{name}"))
    settings = [] if group == "experiment" else settings_of(f"{group}/{name}")
    rows = [table(settings, f"{group}.")] if settings else []
    return "\n\n".join([f"### `{group}={name}`", comment, *rows])
