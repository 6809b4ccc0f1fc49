"""The generated pages of the site: what they hold, without a build; CI builds all of it strictly."""

from __future__ import annotations

import importlib
import re
import sys
from types import SimpleNamespace

import pytest
from helpers.paths import CHECKOUT

import ctgraph_rl
import curricula
from baselines.parts.catalogue import catalogue
from ctgraph_rl import cli, metrics

EXTENSIONS = CHECKOUT / "docs" / "_ext"


@pytest.fixture(scope="module")
def site():
    """Import a module of ``docs/_ext`` by name."""
    before = set(sys.modules)
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.syspath_prepend(str(EXTENSIONS))
        yield importlib.import_module
    for name in {path.stem for path in EXTENSIONS.glob("*.py")} - before:
        sys.modules.pop(name, None)


def test_every_exported_name_stands_on_one_page_of_the_api(site):
    pages = dict(site("api_pages").api_pages())
    listed = re.findall(r"auto(?:class|function):: ctgraph_rl\.(\w+)$", "\n".join(pages.values()), re.MULTILINE)

    assert sorted(listed) == sorted(set(ctgraph_rl.__all__) - {"metrics"})
    index = pages.pop("api/index.rst").split()
    assert (index[index.index("2") + 1], next(iter(pages)), listed[0]) == (
        "environments",
        "api/environments.rst",
        "CTGraphEnv",
    )


@pytest.mark.slow
def test_every_command_and_its_own_commands_show_their_help(site):
    page = dict(site("command_pages").command_pages())["commands.md"]

    headings = re.findall(r"^##+ `ctgraph-rl ?(.*)`$", page, re.MULTILINE)
    assert {*cli.COMMANDS, "", "curricula describe"} <= {*headings}
    assert page.count("usage: ") >= len(cli.COMMANDS)
    assert "\x1b" not in page


def test_every_setting_of_a_run_has_its_default_and_a_comment(site):
    settings = site("yaml_settings").settings_of("config")

    own = [setting for setting in settings if not setting.key.startswith("hydra.")]
    assert ("seed", "0") in [setting[:2] for setting in own]
    assert ("protocol.task_id", "null") in [setting[:2] for setting in own]
    assert [setting.key for setting in own if not setting.comment] == []


@pytest.mark.slow
def test_a_track_has_a_card_with_what_its_tasks_allow(site):
    pages = dict(site("track_cards").track_cards())

    assert sorted(pages) == sorted(f"tracks/{name}.md" for name in ("index", *site("yaml_settings").names_in("track")))
    hidden = (
        "| nothing | `protocol.task_id=hidden` `protocol.boundaries=hidden` | 409,600 | 1 | 0.25 | 1 | 1 | 0.004115 |"
    )
    deeper = "| depth 3 | nothing | `curriculum.depth=3` | 3,072,000 | 1 | 0.5625 | 0.0004572 | 5,919 |"
    assert hidden in pages["tracks/small.md"] and deeper in pages["tracks/adaptation.md"]


def test_a_card_of_a_curriculum_has_its_parts(site):
    card = site("curriculum_cards").card(curricula.load("su_b1_4tasks"), "graphs.png", "similarity.png")

    for part in ("a78b6121f1224f71", "ctgraph-rl curriculum=su_b1_4tasks", "graphs.png", "similarity.png", "| P_R |"):
        assert part in card
    assert "Memory: needed for 2 of 4 tasks, so only agents with memory can solve it: [`drqn`]" in card
    assert "no single policy solves all tasks at once" in card
    assert "soltoggio2023configurable" in card
    assert "baselines.md" in card.split("## Results")[1]


def test_the_card_of_every_named_curriculum_has_a_line_on_results(site):
    """A study's page, or short runs, which are never of the same curriculum, or that there is no run yet."""
    short_runs = site("short_runs")
    run = {line["curriculum"] for line in short_runs.read(short_runs.NAME)}

    first = {}
    for name in curricula.names():
        lines = [short_runs.study_of(name), short_runs.sentence_of(curricula.load(name))]
        first[name] = [line.split()[0] for line in lines if line]
        assert len(first[name]) == (name in run or any(name in names for names in short_runs.STUDIES.values())), name
    assert first["ct8"] == ["Results"] and first["fo_b2_8tasks"] == ["`agent=ppo`,"]


@pytest.mark.parametrize("name", ["ct8", "fo_b2_8tasks"])
def test_a_card_begins_its_results_with_that_line(site, name):
    card = site("curriculum_cards").card(curricula.load(name))
    begins = {"ct8": "Results are on the page [lifelong]", "fo_b2_8tasks": "`agent=ppo`, 102,400 instead of "}

    assert card.split("## Results\n\n")[1].startswith(begins[name])


def test_a_card_without_a_result_says_so(site, monkeypatch):
    monkeypatch.setattr(site("short_runs"), "lines_of", lambda name: {})

    card = site("curriculum_cards").card(curricula.load("fo_b2_8tasks"))

    assert card.split("## Results\n\n")[1].startswith("No run yet: `ctgraph-rl -m experiment=every_curriculum`")


def test_a_card_shows_its_short_runs_in_one_line_and_one_figure(site):
    card = site("curriculum_cards").card(curricula.load("fo_b2_8tasks"), curves="curves.png")
    results = card.split("## Results")[1].split("## Cite")[0].split("\n\n")

    line, figure = (part for part in results if part.strip())
    assert re.fullmatch(
        r"`agent=ppo`, 102,400 instead of 204,800 frames a task\. Mean return over all tasks at the end: 0\.04 .*"
        r" with fine-tuning \(3 seeds; \d\.\d\d right after each task\); .* with Mask RI \(3 seeds, with task ids; .*"
        r" with EWC \(3 seeds, with task ids; .* with multitask \(3 seeds\)\. The optimum is 1; random actions have .*",
        line,
    )
    assert figure == "![Mean return of short runs of fo_b2_8tasks](../figures/curves.png)"


def test_the_studies_of_cards_are_those_of_the_table_of_published_experiments(site):
    page = (CHECKOUT / "docs" / "reference" / "published_experiments.md").read_text(encoding="utf-8")
    cells = [line.strip("|").split(" | ")[4] for line in page.splitlines() if line.startswith("| ")][1:]

    named = {name for names in site("short_runs").STUDIES.values() for name in names}
    assert named == {name for cell in cells for name in re.findall(r"`(\w+)`", cell)}


def test_a_fully_observable_curriculum_needs_no_memory(site):
    cards = site("curriculum_cards")

    assert "Memory: not needed" in cards.card(curricula.load("fo_b1_4tasks"), "a", "b")
    assert [cards.needs_memory(task) for task in curricula.load("su_b1_4tasks").tasks] == [False, True, True, False]


def test_every_source_of_a_curriculum_has_bibtex(site):
    entries_of = site("bibliography").entries_of

    assert [name for name in curricula.names() if not entries_of(curricula.load(name).source)] == []


@pytest.fixture(scope="module")
def cards(site) -> dict[str, str]:
    """The cards of agents, methods, detectors and metrics by their files."""
    return {**dict(site("baseline_cards").baseline_cards()), **dict(site("metric_cards").metric_cards())}


def test_every_agent_method_detector_and_metric_has_a_card(cards):
    pages = cards.keys()

    for group in ("agent", "cell", "method", "detector"):
        assert {f"{group}s/{entry.name}.md" for entry in catalogue(group)} <= pages
    assert {f"metrics/{name}.md" for name in metrics.definitions()} <= pages
    listed = cards["metrics/index.md"]
    assert all(f"| `{each.id}` | `{each.formula}` |" in listed for each in metrics.definitions().values())


def test_cards_show_settings_variants_results_and_examples(cards):
    assert "| `method.coeff` | `100.0` | lambda |" in cards["methods/ewc.md"]
    assert "| `agent.cell.num_frames` | `4` |" in cards["cells/frames.md"]
    assert "### `method=ewc_published`" in cards["methods/ewc.md"]
    assert "Raw: `methods.csv`" in cards["methods/ewc.md"]
    assert "Raw: `baselines_b1.csv`" in cards["agents/a2c.md"]
    assert "**-0.45**; its terms are -0.6, -0.3" in cards["metrics/backward_transfer.md"]


def test_links_to_files_beside_docs_lead_to_their_pages(site):
    pytest.importorskip("docutils", reason="needs the extra docs")
    relocated = site("links").relocated
    text = (
        "[a](../../SECURITY.md#x) [b](loggers.md) [c](../../baselines/ppo.py) [d](https://x.y/z.md) ![e](../../p.png)"
    )

    moved = relocated(text, "docs/how-to/resume.md", "docs/how-to/resume.md", "")

    assert moved == "[a](../generated/security.md#x) [b](loggers.md) c [d](https://x.y/z.md) ![e](../../p.png)"
    there = relocated(
        "[c](../../baselines/ppo.py)", "docs/how-to/resume.md", "docs/how-to/resume.md", "https://host/repository"
    )
    assert there == "[c](https://host/repository/blob/main/baselines/ppo.py)"


def test_every_tile_of_the_gallery_has_its_command_and_its_figure(site, tmp_path, monkeypatch):
    monkeypatch.setattr(site("gallery"), "DRAWN", {"A task": "draw CT-FO-B1 --figure FIGURE"})

    page = site("gallery").gallery_page(tmp_path / "figures")

    commands = re.findall(r"```bash\n(.*)\n```", page)
    figures = re.findall(r"!\[.*?\]\((.*?)\)", page)
    assert len(commands) == len(figures) >= 15
    assert [each for each in figures if not (tmp_path if each[0] != "." else EXTENSIONS).joinpath(each).is_file()] == []


def test_the_index_for_language_models_has_a_line_for_each_page(site, tmp_path):
    pytest.importorskip("sphinx", reason="needs the extra docs")
    (tmp_path / "a.md").write_text("# A\n\nWhat it is. More.\n", encoding="utf-8")
    titles = {"a": SimpleNamespace(astext=lambda: "A")}
    environment = SimpleNamespace(titles=titles, found_docs={"a"}, doc2path=lambda name: tmp_path / f"{name}.md")
    app = SimpleNamespace(env=environment, outdir=tmp_path, builder=SimpleNamespace(format="html"))

    site("llms").write_index(app, None)

    assert "- [A](a.html): What it is\n" in (tmp_path / "llms.txt").read_text(encoding="utf-8")
    assert "More." in (tmp_path / "llms-full.txt").read_text(encoding="utf-8")
