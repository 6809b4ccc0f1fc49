"""Pages made of jinja2 templates and texts of other people."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ctgraph_rl.log.escape import markdown_text, terminal_text


def rendered(template: Path, **values: Any) -> str:
    """Return a page; in HTML texts are escaped, each in one line without control characters.

    Args:
        template: its file, ``NAME.html.j2`` or ``NAME.md.j2``.
    """
    from jinja2 import FileSystemLoader, StrictUndefined
    from jinja2.sandbox import SandboxedEnvironment

    escapes = template.name.endswith(".html.j2")
    environment = SandboxedEnvironment(
        loader=FileSystemLoader(template.parent),
        autoescape=escapes,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    if escapes:
        environment.finalize = lambda value: terminal_text(value) if type(value) is str else value
    environment.filters["line"] = markdown_text
    return environment.get_template(template.name).render(values)
