"""The page of the methods, lifelong.md, and its figures."""

from __future__ import annotations

from string import Template

from studies.lifelong import comparison, pairs
from studies.lifelong.experiments import EXPERIMENTS, MASKS, eight
from studies.raw import HERE, TEMPLATES, machines, read

PAGE = HERE / "lifelong.md"


def page() -> str:
    """The page of the methods: its template with its tables."""
    template = Template((TEMPLATES / "lifelong.md").read_text(encoding="utf-8"))
    found = comparison.tables() | pairs.tables()
    read_here = (*EXPERIMENTS, *map(eight, MASKS))
    return template.substitute(found, machines=machines(*read_here))


def make() -> None:
    """Write the page and its figures."""
    PAGE.write_text(page(), encoding="utf-8")
    for name in MASKS:
        if read(name):
            comparison.draw(name, HERE / f"{name}.png")
    comparison.draw_by_agent(HERE / "methods.png")
