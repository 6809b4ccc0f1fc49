"""How long pages are: in all, each, and the running text of a page of results."""

from __future__ import annotations

import json
import re
from pathlib import Path

from helpers.paths import CHECKOUT, sources

CODE = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)
FOLD = re.compile(r"<details>.*?</details>", re.DOTALL)
ROW = re.compile(r"^\s*\|.*$", re.MULTILINE)


def prose(path: Path) -> str:
    """A page, or the Markdown of a notebook, without its code blocks."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        text = "\n\n".join("".join(c["source"]) for c in json.loads(text)["cells"] if c["cell_type"] == "markdown")
    return CODE.sub("", text)


def words(text: str, of: str = "[A-Za-z]") -> int:
    return sum(re.search(of, each) is not None for each in text.split())


PAGES = {
    path.relative_to(CHECKOUT).as_posix(): prose(path)
    for path in sources((".md", ".ipynb"))
    if path.is_relative_to(CHECKOUT / "docs") and not {"templates", "board"} & {*path.relative_to(CHECKOUT).parts}
}


def test_readme_and_all_pages_have_at_most_58_000_words_with_code_and_tables():
    """As ``wc -w`` counts them: marks of tables are words, too."""
    files = [path for path in sources((".md",)) if path.relative_to(CHECKOUT).parts[0] in ("README.md", "docs")]
    counts = [len(path.read_text(encoding="utf-8").split()) for path in files if "templates" not in path.parts]

    assert len(counts) > 70
    assert sum(counts) <= 58_000


def test_all_pages_and_notebooks_have_at_most_48_000_words_and_numbers_outside_of_code():
    assert len(PAGES) > 70
    assert sum(words(text, "[A-Za-z0-9]") for text in PAGES.values()) <= 48_000


def test_a_page_has_at_most_1_700_words_and_a_page_of_results_1_200_outside_of_tables_and_folds():
    running = {
        name: ROW.sub("", FOLD.sub("", text)) for name, text in PAGES.items() if name.startswith("docs/results/")
    }

    assert len(running) > 7
    assert {name: words(text) for name, text in PAGES.items() if words(text) > 1700} == {}
    assert {name: words(text) for name, text in running.items() if words(text) > 1200} == {}
