"""The report in a real browser: every figure is decoded, nothing is fetched, and names are text."""

from __future__ import annotations

import re
import shutil
import subprocess
from html.parser import HTMLParser

import pytest
from helpers.made_runs import write_run

from ctgraph_rl.report.page import write_report

for package in ("matplotlib", "jinja2", "scipy"):
    pytest.importorskip(package)

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason="needs a browser: apt-get install chromium"),
]

NAME = "<img src=x onerror=document.title='attacked'>"
POLICY = re.compile(r'<meta http-equiv="Content-Security-Policy" content="default-src \'none\';[^>]*>')
MEASURE = """<script>
addEventListener("load", () => {
  const widths = [...document.images].map(image => image.naturalWidth);
  document.body.setAttribute("data-widths", widths.join(" "));
  document.body.setAttribute("data-fetched", performance.getEntriesByType("resource").map(e => e.name)
    .filter(name => !name.startsWith("data:")).join(" "));
});
</script>"""


class Page(HTMLParser):
    """Elements, and all text of a page as the browser holds it."""

    def __init__(self, dom: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(dom)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.text += data

    def all(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]


def opened(page, profile) -> Page:
    """A page as the browser holds it after loading, without a network."""
    quiet = ("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking")
    offline = ("--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={profile}")
    command = [BROWSER, *quiet, *offline, "--virtual-time-budget=20000", "--dump-dom", page.as_uri()]
    result = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert result.returncode == 0, result.stderr
    return Page(result.stdout)


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """A report of two agents, one of an ugly name, and how many figures it has."""
    folder = tmp_path_factory.mktemp("browser")
    for seed in range(2):
        write_run(folder / "runs" / f"mine{seed}", seed=seed, agent=NAME, labels=(NAME, "goal2"))
        write_run(folder / "runs" / f"ours{seed}", seed=seed, labels=(NAME, "goal2"))
    page = write_report([folder / "runs"]).page
    return page, len(list(page.parent.glob("figures/*.png")))


def test_every_figure_is_decoded_and_nothing_is_fetched(report, tmp_path):
    page, count = report
    html = page.read_text()
    measured = tmp_path / "measured.html"
    measured.write_text(POLICY.sub("", html).replace("</body>", f"{MEASURE}</body>"))

    (body,) = opened(measured, tmp_path / "profile").all("body")

    widths = [int(width) for width in body["data-widths"].split()]
    assert POLICY.search(html)
    assert count == 5
    assert len(widths) == count and min(widths) > 500
    assert body["data-fetched"] == ""


def test_a_name_with_html_is_shown_as_text(report, tmp_path):
    page, count = report

    seen = opened(page, tmp_path / "profile")

    assert len(seen.all("img")) == count
    assert all(image["alt"] and image["src"].startswith("data:image/png;base64,") for image in seen.all("img"))
    assert {link["href"][0] for link in seen.all("a")} == {"#"}
    assert not seen.all("script") and not seen.all("link")
    assert seen.text.count(NAME) > 5
    assert all("onerror" not in attributes for _, attributes in seen.elements)
