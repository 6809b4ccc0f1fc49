"""Pages of the documentation: links and the paths of pages that code and pages name lead to files."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from helpers.paths import CHECKOUT, TESTS, sources

TEXTS = (".md", ".ipynb", ".py", ".yaml", ".toml", ".cff")


def prose(path: Path) -> str:
    """The Markdown of a page or notebook without its code blocks."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        text = "\n\n".join(
            "".join(cell["source"]) for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown"
        )
    return re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)


FILES = sources(TEXTS)
PAGES = [path for path in FILES if path.suffix in (".md", ".ipynb") and not path.is_relative_to(TESTS)]


def test_every_page_of_docs_that_a_file_names_exists():
    named = {
        (path.relative_to(CHECKOUT).as_posix(), name)
        for path in FILES
        if path.name != "CHANGELOG.md"  # which also names files of earlier versions
        for name in re.findall(r"(?<![\w/])docs/[\w/.-]+\.(?:md|ipynb|py|png|csv)\b", path.read_text(encoding="utf-8"))
    }

    assert len(named) > 50
    written = {pair for pair in named if not pair[1].startswith("docs/generated/")}
    assert [pair for pair in sorted(written) if not (CHECKOUT / pair[1]).is_file()] == []


def test_every_figure_of_a_page_has_a_text_in_its_place():
    silent = re.compile(r"!\[\s*\]\(|<img(?![^>]*\balt=\"[^\"])|```\{(?:image|figure)\}(?![^`]*:alt: \S)")
    pages = {page: page.read_text(encoding="utf-8") for page in PAGES if page.suffix == ".md"}
    notebooks = [page for page in PAGES if page.suffix == ".ipynb"]
    cells = [(page.name, cell) for page in notebooks for cell in json.loads(page.read_text(encoding="utf-8"))["cells"]]
    drawn = [(name, cell) for name, cell in cells if '"image/png"' in json.dumps(cell.get("outputs", []))]

    assert [page for page, text in pages.items() if silent.search(text)] == []
    assert len(drawn) >= 5
    assert [name for name, cell in drawn if not cell["metadata"].get("mystnb", {}).get("image", {}).get("alt")] == []


def test_links_have_titles_and_no_names_of_files_as_their_text():
    named = re.compile(r"\[`?[\w./-]+\.(?:md|ipynb|html)`?\]\(")
    pages = {page: page.read_text(encoding="utf-8") for page in PAGES if page.name != "CHANGELOG.md"}

    assert {page.name: named.findall(text) for page, text in pages.items() if named.search(text)} == {}


@pytest.mark.parametrize("page", PAGES, ids=[path.relative_to(CHECKOUT).as_posix() for path in PAGES])
def test_every_link_of_a_page_leads_to_a_file(page):
    folder = page.parent
    if folder.name == "templates":
        folder = CHECKOUT / "docs" / "results"
    links = re.findall(r"\]\((?!\w+:)([^)\s#]+)", prose(page))
    links = [link for link in links if "generated/" not in link]  # the strict build checks those

    assert [link for link in links if not (folder / link).exists()] == []


def test_pages_install_in_one_way():
    """A checkout by ``pip install -c constraints.txt -e .``, extras by ``pip install 'ctgraph_rl[NAME]'``."""
    pages = [*sources((".md", ".ipynb"))]
    found = [
        (page.name, each) for page in pages for each in re.findall(r"pip install [^`\n|&]+", page.read_text("utf-8"))
    ]
    ours = [each for each in found if "ctgraph_rl" in each[1] or "constraints" in each[1] or " ." in each[1]]
    way = re.compile(r"pip install (-c constraints\.txt -e (\.|'\.\[\w+\]')|'ctgraph_rl\[[\w,]+\]')[ .]*")

    assert len(ours) > 20
    assert [each for each in ours if not way.fullmatch(each[1].partition(" first")[0].partition(" installs")[0])] == []
