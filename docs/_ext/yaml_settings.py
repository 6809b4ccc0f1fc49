"""The settings of the yaml files in ``conf``, with their defaults and comments."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import yaml

from ctgraph_rl.packages import conf_dir

CONF = Path(conf_dir())

ALONE = "---\norphan: true\n---"
"""Says that no table of contents lists a page: the sidebar of all pages would be long, and slow to build."""


class Setting(NamedTuple):
    """A line of a yaml file: dotted key, default and comment."""

    key: str
    default: str
    comment: str


def settings_of(name: str) -> list[Setting]:
    """Return the settings of ``conf/NAME.yaml``, without ``_target_`` and defaults lists."""
    text = _text(name)
    root = yaml.compose(text)
    found = _walk(root, "", text) if isinstance(root, yaml.MappingNode) else ()
    return [setting for setting in found if not setting.key.startswith(("_target_", "_partial_", "defaults"))]


def first_comment(name: str) -> str:
    """Return the first line of ``conf/NAME.yaml`` that says what the file is."""
    lines = [line for line in _text(name).splitlines() if line.startswith("# ") and "@package" not in line]
    return lines[0].removeprefix("# ") if lines else ""


def names_in(group: str) -> list[str]:
    """Return the names of the yaml files in a folder of ``conf``."""
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def base_of(group: str, name: str) -> str | None:
    """Return which file of its folder a yaml file changes values of, if any."""
    defaults = yaml.safe_load(_text(f"{group}/{name}")).get("defaults", [])
    return next((entry for entry in defaults if isinstance(entry, str) and entry in names_in(group)), None)


def table(settings: list[Setting], prefix: str = "") -> str:
    """Return settings as a table in Markdown."""
    rows = [f"| `{prefix}{key}` | `{default}` | {escaped(comment)} |" for key, default, comment in settings]
    return "\n".join(["| setting | default | meaning |", "|---|---|---|", *rows])


def escaped(text: str) -> str:
    """Return a plain text for a cell of a table in Markdown."""
    return re.sub(r"([|*_\[\]<>$])", r"\\\1", text)


def _text(name: str) -> str:
    return (CONF / f"{name}.yaml").read_text(encoding="utf-8")


def _walk(node: yaml.MappingNode, prefix: str, text: str) -> Iterator[Setting]:
    for key, value in node.value:
        name = f"{prefix}{key.value}"
        if isinstance(value, yaml.MappingNode):
            yield from _walk(value, f"{name}.", text)
        else:
            default = text[value.start_mark.index : value.end_mark.index]
            yield Setting(name, default or "null", _comment(text, value.end_mark.index))


def _comment(text: str, index: int) -> str:
    """Return the comment on the rest of the line from an index on."""
    rest = text[index:].split("\n", 1)[0].strip()
    return rest.removeprefix("#").strip() if rest.startswith("#") else ""
