"""Code in pages: Python runs and prints what the page shows; shell lines run, or are composed and parsed.

This covers every page of ``docs`` and README, new ones too. Blocks ``python`` of a page run one after the other in an
empty directory; blocks ``py`` are only compiled, as they need what a page cannot have, such as a run. A block ``text``
right after one of Python is what that prints; ``...`` stands for anything. A block after a paragraph that names a file
and ends with a colon is also written to that file.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from argparse import ArgumentParser
from collections.abc import Callable, Iterator
from doctest import ELLIPSIS, NORMALIZE_WHITESPACE, OutputChecker
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import hydra
import pytest
from helpers.paths import CHECKOUT
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.utils import instantiate

from ctgraph_rl import cli, packages, parsers

PAGES = {
    path.relative_to(CHECKOUT).as_posix(): path
    for path in sorted([CHECKOUT / "README.md", *(CHECKOUT / "docs").rglob("*.md")])
    if not {"generated", "_build", "templates"} & {*path.relative_to(CHECKOUT).parts}
}
ELSEWHERE = {
    "README.md": "test_readme",
    "docs/how-to/migrate.md": "test_docs",
    "docs/how-to/search.md": "test_search_page",
    "docs/how-to/torchrl.md": "test_docs",
    "docs/reference/curricula.md": "test_cli",
    "docs/reference/methods.md": "test_methods_docs",
    "docs/reference/metrics.md": "test_metrics_page",
}
"""Pages whose Python another test runs, in the files that it needs."""

LONG = (
    *("docs/how-to/collectives.md", "docs/how-to/go_fast.md", "docs/how-to/sb3_and_gymnasium.md"),
    *("docs/how-to/recorder.md", "docs/how-to/torchrl_ppo.md", "docs/how-to/train_in_python.md"),
)
"""Pages whose Python takes over a second: it is compiled, and runs with the slow tests."""

FEWER_FRAMES = ('"fo_b1_4tasks", num_frames=20_480', '"fo_b1_4tasks", num_frames=2_048')
"""What a block with no output that the page shows is run with: half a minute less each."""

MANY_COMMANDS = ("docs/results/collectives.md", "docs/results/memory.md")
"""Pages whose commands take over a second to compose."""

QUICK = {"agents", "curricula", "methods"}
"""Commands that run here; others are parsed: they need runs, a terminal, or are run by the tests of pictures."""

BLOCK = re.compile(r"^( *)```(\w*)\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)
FILE = re.compile(r"^[^\n]*?`([\w/]+\.(?:py|yaml|json))`[^\n]*:\n+\Z", re.MULTILINE)


class Block(NamedTuple):
    file: str
    """The file that the paragraph before it names, if any."""
    language: str
    text: str
    printed: str | None
    """What the page says that it prints."""


def blocks(page: Path) -> Iterator[Block]:
    text = page.read_text(encoding="utf-8")
    found = list(BLOCK.finditer(text))
    for match, after in zip(found, [*found[1:], None], strict=False):
        follows = after is not None and after[2] == "text" and not text[match.end() : after.start()].strip()
        file = FILE.search(text, 0, match.start())
        code = re.sub(f"^{match[1]}", "", match[3], flags=re.MULTILINE)
        yield Block(file[1] if file else "", match[2], code, after[3] if follows else None)


def with_blocks(*languages: str) -> list[str]:
    return [name for name, path in PAGES.items() if any(block.language in languages for block in blocks(path))]


def write_files(page: Path, folder: Path) -> None:
    """Write the files that a page shows."""
    for block in blocks(page):
        if block.file:
            path = folder / block.file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.text, encoding="utf-8")


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """An empty working directory that Python imports from."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


@pytest.mark.parametrize("name", with_blocks("python", "py"))
def test_the_python_of_a_page_is_python(name):
    for number, block in enumerate(blocks(PAGES[name]), 1):
        if block.language in ("python", "py"):
            compile(block.text, f"{name}, block {number}", "exec")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] if name in LONG else [])
        for name in with_blocks("python")
        if name not in ELSEWHERE
    ],
)
def test_the_python_of_a_page_runs_and_prints_what_it_shows(name, folder, capsys):
    write_files(PAGES[name], folder)
    names = {"__name__": "__main__"}

    for number, block in enumerate(blocks(PAGES[name]), 1):
        if block.language != "python":
            continue
        code = block.text.replace(*FEWER_FRAMES) if block.printed is None else block.text
        exec(compile(code, f"{name}, block {number}", "exec"), names)
        printed = capsys.readouterr().out
        if block.printed is not None:
            assert OutputChecker().check_output(block.printed, printed, ELLIPSIS | NORMALIZE_WHITESPACE), printed


def test_pages_whose_python_runs_elsewhere_exist_and_have_python():
    assert set(ELSEWHERE) <= set(with_blocks("python"))
    assert [test for test in ELSEWHERE.values() if not [*(CHECKOUT / "tests").rglob(f"{test}.py")]] == []


def shell_lines(page: Path) -> Iterator[str]:
    """Commands in the shell blocks of a page, without comments."""
    for block in blocks(page):
        if block.language in ("bash", "sh"):
            joined = re.sub(r"\$\(\([^)]*\)\)", "2", block.text.replace("\\\n", " "))
            joined = re.sub(r"\$\w+", "1", joined)
            parts = [
                part
                for line in joined.splitlines()
                for part in re.split(r" && |; (?=done|do )", re.sub(r" >>? .*", "", line))
            ]
            yield from (part.strip() for part in parts if part.strip() and not part.strip().startswith("#"))


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] if name in MANY_COMMANDS else [])
        for name in with_blocks("bash", "sh")
    ],
)
def test_every_shell_line_of_a_page_runs_or_is_composed_and_parsed(name, folder, monkeypatch, capsys):
    write_files(PAGES[name], folder)
    for block in blocks(PAGES[name]):
        if block.language in ("bash", "sh"):
            assert subprocess.run(["bash", "-n"], input=block.text, text=True).returncode == 0

    for line in shell_lines(PAGES[name]):
        words = shlex.split(line, comments=True)
        words = words[1:] if words[0] == "srun" else words
        if words[0] == "ctgraph-rl":
            follow(words[1:], folder, monkeypatch)
        elif words[:2] == ["python", "-m"]:
            module(words[2], words[3:], folder, monkeypatch)
        elif words[0] == "python":
            assert (CHECKOUT / words[1]).is_file(), line


def module(name: str, words: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Follow a line that begins with ``python -m``."""
    if name == "ctgraph_rl.run":
        compose(words, folder)
    else:
        command = {"curricula": "curricula", "baselines": "agents", "baselines.methods": "methods"}
        if name in command:
            follow([command[name], *words], folder, monkeypatch)
        else:
            parse(import_module(name).main, [name, *words], monkeypatch)


def follow(words: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run, compose or parse a line that begins with ``ctgraph-rl``."""
    if words and words[0] in cli.COMMANDS and words[0] != "run":
        monkeypatch.setattr(sys, "argv", ["ctgraph-rl", *words])
        if words[0] in QUICK:
            cli.main()
        else:
            parse(cli.main, ["ctgraph-rl", *words], monkeypatch)
    elif words:
        compose([word for word in words if word != "run"], folder)


def parse(main: Callable[[], None], argv: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a command parse its arguments, and end there."""

    class Parsed(Exception):
        pass

    original = ArgumentParser.parse_args

    def parse_args(self: ArgumentParser, args: list[str] | None = None, namespace: object = None) -> None:
        original(self, args, namespace)
        raise Parsed

    with monkeypatch.context() as patch:
        patch.setattr(sys, "argv", argv)
        patch.setattr(ArgumentParser, "parse_args", parse_args)
        patch.setattr(parsers, "existing", Path)  # the runs of a page are not there
        with pytest.raises(Parsed):
            main()


def compose(words: list[str], folder: Path) -> None:
    """Compose the configuration of a run, or of the first cell of a sweep, and build its curriculum."""
    options = hydra._internal.utils.get_args_parser().parse_args(words)
    overrides = [first_choice(override) for override in options.overrides]
    GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(packages.conf_dir(), version_base="1.3"):
        path = [f"hydra.searchpath=[file://{folder / options.config_dir}]"] if options.config_dir else []
        cfg = hydra.compose("config", overrides=[*overrides, *path], return_hydra_config=True)
    assert instantiate(cfg.curriculum).num_frames > 0


def first_choice(override: str) -> str:
    """Return an override with the first of its choices."""
    (parsed,) = OverridesParser.create().parse_overrides([override])
    if not parsed.is_sweep_override():
        return override
    return f"{parsed.get_key_element()}={next(parsed.sweep_string_iterator())}"
