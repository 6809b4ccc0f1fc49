"""Makes the generated pages of the site, before Sphinx reads anything, in ``docs/generated``."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

from api_pages import api_pages
from baseline_cards import baseline_cards
from command_pages import command_pages
from curriculum_cards import curriculum_cards
from figures import draw_all
from gallery import gallery_page
from links import OUTSIDE, relocated
from metric_cards import metric_cards
from sphinx.application import Sphinx
from track_cards import track_cards

FOLDER = "generated"


def write(path: Path, text: str) -> None:
    """Write a page, unless it stands there already: Sphinx then reads it again only if it changed."""
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


def generate(app: Sphinx) -> None:
    """Write all generated pages, and remove those that are generated no more."""
    folder = Path(app.srcdir) / FOLDER
    figures = draw_all(folder / "figures")
    cards = (baseline_cards(), metric_cards(), track_cards(), curriculum_cards(figures))
    made = (api_pages(), command_pages(), *cards)
    pages = {folder / path: text for path, text in chain(*made)}
    pages[folder / "gallery.md"] = gallery_page(folder / "figures")
    pages |= {folder.parents[1] / page: _copy(app, name, page) for name, page in OUTSIDE.items() if FOLDER in page}
    for path, text in pages.items():
        write(path, text)
    for path in folder.rglob("*.*"):
        if path.suffix in (".md", ".rst") and path not in pages:
            path.unlink()


def _copy(app: Sphinx, name: str, page: str) -> str:
    """Return the page that shows a file beside ``docs``."""
    text = (Path(app.srcdir).parent / name).read_text(encoding="utf-8")
    return relocated(text, name, page, app.config.repository)


def setup(app: Sphinx) -> dict[str, bool]:
    """Generate pages when a build starts."""
    app.connect("builder-inited", generate)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
