"""The yaml files in ``conf/curriculum``, which ``python -m tests.helpers.conf_files`` writes.

Names, defaults and comments are those of the functions' signatures and docstrings, where alone they are changed.
"""

from __future__ import annotations

import re
from inspect import getdoc, signature, unwrap
from pathlib import Path

import yaml

import curricula
from ctgraph_rl.packages import conf_dir

ARGUMENT = re.compile(r"^    (\w+): (.+(?:\n {5,}.+)*)", re.MULTILINE)
"""An argument in a docstring, and what it means."""

WORDS = {"`": "", "None": "null", "True": "true", "False": "false"}
"""What yaml writes for what Python writes."""


UNNAMED = {"axes": "from_axes", "graph": "from_graph"}
"""Files of curricula that are made of settings, with their functions."""


def conf_file(name: str) -> str:
    """Return the yaml file of a curriculum: what it is, and each argument with its default and its meaning."""
    target = UNNAMED.get(name, name)
    function = unwrap(getattr(curricula, target))
    text = getdoc(getattr(function, "func", function)) or ""
    for python, word in WORDS.items():
        text = text.replace(python, word)
    meanings = dict(ARGUMENT.findall(text))
    settings = {}
    for parameter in signature(function).parameters.values():
        value = yaml.safe_dump(parameter.default).splitlines()[0]
        settings[f"{parameter.name}: {value}"] = " ".join(meanings[parameter.name].split()).removesuffix(".")
    width = max(map(len, settings))
    lines = [f"# {text.splitlines()[0]}", f"_target_: curricula.{target}"]
    lines += [f"{setting:{width}}  # {meaning}" for setting, meaning in settings.items()]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    for each in (*curricula.names(), *UNNAMED):
        Path(conf_dir(), "curriculum", f"{each}.yaml").write_text(conf_file(each), encoding="utf-8")
