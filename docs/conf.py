"""Sphinx configuration of the documentation; build it with ``sphinx-build -nW --keep-going docs docs/_build``.

Pages are MyST Markdown and notebooks with their stored output. What ``docs/_ext`` generates goes to ``docs/generated``,
which git ignores.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE / "results"), str(HERE.parent)]

from ctgraph_rl import __version__  # noqa: E402

PROJECT = tomllib.loads((HERE.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"]

project = PROJECT["name"]
author = copyright = "the ctgraph_rl developers"
version = release = __version__
repository = PROJECT.get("urls", {}).get("Repository", "")

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton", "sphinx_design"]
extensions += ["links", "generate", "llms"]
exclude_patterns = ["_build", "results/templates"]
templates_path: list[str] = []
nitpicky = True

myst_enable_extensions = ["attrs_block", "attrs_inline", "colon_fence", "deflist", "dollarmath", "fieldlist"]
myst_heading_anchors = 4
nb_execution_mode = "off"
nb_output_stderr = "remove"
highlight_language = "none"  # of blocks that name none, such as what a command prints

html_theme = "furo"
html_title = f"{project} {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {"source_repository": repository, "source_branch": "main", "source_directory": "docs/"}
html_copy_source = False
copybutton_exclude = ".linenos, .gp, .go"  # prompts and what is printed

default_role = "py:obj"
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 100
napoleon_use_rtype = False
OTHERS = (
    "collections|fractions|gymnasium|matplotlib|numpy|optional|os|pandas|pathlib|stable_baselines3|tensordict|torch"
    "|torchrl|types"
)
SHORT_NAMES = (
    "NDArray|Path|Sequence|Span|Tensor|TensorDictBase|nn.Module|nn.Linear|Rule|NamedValues|ReadOnlyValues|Items|Learnt"
    "|TensorsByName"
    r"|baselines\.(cavia\.Context|maml\.AllWeights)"  # models of inner loops
    r"|ctgraph_rl\.tasks\.life\.\w+"  # parts of a stream
    r"|ctgraph_rl\.tasks\.observations\.Number"  # a type variable
)
SETTINGS = r"baselines\.\w+\.\w+Settings"  # the cards of agents list them
nitpick_ignore_regex = [("py:.*", rf"({OTHERS})(\..*)?"), ("py:class", rf"{SHORT_NAMES}|{SETTINGS}")]


def without_aliases(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Drop the docstrings that Python gives to fields of named tuples, which say nothing."""
    if lines and lines[0].startswith("Alias for field number"):
        lines.clear()


def setup(app: Any) -> None:
    """Connect what this file adds to Sphinx."""
    app.connect("autodoc-process-docstring", without_aliases, priority=300)  # before a handler that adds a line
