"""The agents and methods of this package, as the yaml files in ``conf`` name them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from ctgraph_rl.packages import class_named, conf_dir


class Entry(NamedTuple):
    """A yaml file with the class that it names."""

    name: str
    kind: Any
    settings: dict[str, Any]
    comment: str  # its first line


def catalogue(group: str) -> Iterator[Entry]:
    """Yield an entry for each yaml file in ``conf/GROUP``, except those that only change values of another one."""
    for path in sorted(Path(conf_dir(), group).glob("*.yaml")):
        text = path.read_text(encoding="utf-8")
        settings = yaml.safe_load(text)
        if "_target_" in settings:
            module, _, name = settings.pop("_target_").rpartition(".")
            yield Entry(path.stem, class_named(module, name), settings, text.splitlines()[0].removeprefix("# "))
