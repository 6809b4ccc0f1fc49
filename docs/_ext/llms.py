"""``llms.txt``, an index of the pages for language models with a line each, and ``llms-full.txt`` with their text."""

from __future__ import annotations

from pathlib import Path

from sphinx.application import Sphinx

LEAD = "CT-graphs as batched TorchRL environments, with lifelong-learning curricula, baselines and metrics."


def write_index(app: Sphinx, error: Exception | None) -> None:
    """Write both files beside the pages, when HTML was built."""
    if error is not None or app.builder.format != "html":
        return
    titles = {name: app.env.titles[name].astext() for name in sorted(app.env.found_docs)}
    lines = [f"- [{title}]({name}.html){_sentence(app, name)}" for name, title in titles.items()]
    out = Path(app.outdir)
    (out / "llms.txt").write_text("\n".join(["# ctgraph_rl", "", f"> {LEAD}", "", *lines, ""]), encoding="utf-8")
    written = [name for name in titles if not name.startswith("generated/") and _source(app, name).suffix == ".md"]
    texts = [f"<!-- {name} -->\n\n{_source(app, name).read_text(encoding='utf-8')}" for name in written]
    (out / "llms-full.txt").write_text("\n\n".join(texts), encoding="utf-8")


def _source(app: Sphinx, name: str) -> Path:
    return Path(app.env.doc2path(name))


def _sentence(app: Sphinx, name: str) -> str:
    """Return the first sentence of a page's first paragraph, after a colon."""
    lines = _source(app, name).read_text(encoding="utf-8").split("\n\n")
    plain = [part for part in lines if part[:1].isalpha() or part[:1] == "`"]
    return f": {' '.join(plain[0].split()).split('. ')[0].rstrip('.')}" if plain else ""


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the index when a build ends."""
    app.connect("build-finished", write_index)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
