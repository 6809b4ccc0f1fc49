"""Links of pages: to files beside ``docs``, to names of Python, and from generated copies of files beside ``docs``."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.inspect import signature as signature_of
from sphinx.util.inspect import stringify_signature
from sphinx.util.nodes import make_refnode

OUTSIDE = {
    "CHANGELOG.md": "docs/generated/changelog.md",
    "CONTRIBUTING.md": "docs/generated/contributing.md",
    "README.md": "docs/index.md",
    "SECURITY.md": "docs/generated/security.md",
}
"""Files beside ``docs``, and the pages of the site that hold what they say."""

TYPE_VARIABLES = ("Arguments", "Batch")

LINK = re.compile(r"(?<!!)\[([^\[\]]*)\]\((?!\w+:|#)([^)\s#]+)(#[^)\s]*)?\)")


def relocated(text: str, source: str, page: str, repository: str) -> str:
    """Return the Markdown of a file with links that are right where its page stands.

    Args:
        text: the Markdown, or the JSON of a notebook.
        source: the file's path in the repository, which its links start from.
        page: the page's path in the repository.
        repository: the address of the repository; if empty, a link to a file that no page shows becomes its text.
    """

    def replace(match: re.Match[str]) -> str:
        label, link, anchor = match.group(1), match.group(2), match.group(3) or ""
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), link))
        target = OUTSIDE.get(target, target)
        if target.startswith("docs/"):
            return f"[{label}]({posixpath.relpath(target, posixpath.dirname(page))}{anchor})"
        return f"[{label}]({repository}/blob/main/{target}{anchor})" if repository else label

    return LINK.sub(replace, text)


def lead_to_pages(app: Sphinx, docname: str, content: list[str]) -> None:
    """Replace links of a page to files beside ``docs``."""
    path = Path(app.env.doc2path(docname))
    if path.suffix in (".md", ".ipynb"):
        page = f"docs/{path.relative_to(app.srcdir).as_posix()}"
        content[0] = relocated(content[0], page, page, app.config.repository)


def resolve_name(app: Sphinx, env: BuildEnvironment, node: Any, contnode: nodes.Element) -> nodes.Node | None:
    """Resolve a name of Python that is written without its module.

    What single backticks of a docstring hold need not be a name: without an object it is shown as it is, as are type
    variables and private types. Any other type of ours that no page documents is an error.
    """
    if node.get("refdomain") != "py":
        return None
    domain, target = env.domains.python_domain, node["reftarget"]
    found = sorted(name for name in domain.objects if name.endswith(f".{target.lstrip('.')}"))
    if found:
        entry = domain.objects[found[0]]
        return make_refnode(app.builder, node["refdoc"], entry.docname, entry.node_id, contnode, found[0])
    name = target.rpartition(".")[2]
    return contnode if node["reftype"] == "obj" or name.startswith("_") or name in TYPE_VARIABLES else None


def as_text(app: Sphinx, what: str, name: str, obj: object, options: Any, lines: list[str]) -> None:
    """Show a docstring's bars and stars as they are, and let no word before a colon be the type of an attribute."""
    parts = re.split(r"(``.+?``)", "\n".join(lines), flags=re.DOTALL)
    parts[::2] = [re.sub(r"(?<!\\)([|*])", r"\\\1", part) for part in parts[::2]]
    lines[:] = "".join(parts).split("\n")
    if what in ("attribute", "data", "property"):
        lines.insert(0, "\\ ")


def _is_own(method: Any, of: Any) -> bool:
    """Return whether a class's module defines a method; Python's own methods have no module."""
    return getattr(method, "__module__", None) == of.__module__


def with_plain_defaults(
    app: Sphinx, what: str, name: str, obj: object, options: Any, signature: str | None, returned: str | None
) -> tuple[str | None, str | None]:
    """Write a default that a factory makes as ``...``: the whole signature could not be parsed else.

    A class of ours whose metaclass hides its arguments, as TorchRL's, gets those of its ``__init__``.
    """
    if what == "class" and signature == "(*args, **kwargs)" and _is_own(obj.__init__, obj):
        own = signature_of(obj.__init__, bound_method=True)
        signature = stringify_signature(own, show_return_annotation=False, unqualified_typehints=True)
    return signature and signature.replace("<factory>", "..."), returned


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect the handlers."""
    app.add_config_value("repository", "", "env")
    app.connect("source-read", lead_to_pages)
    app.connect("missing-reference", resolve_name)
    app.connect("autodoc-process-docstring", as_text, priority=400)
    app.connect("autodoc-process-signature", with_plain_defaults)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
