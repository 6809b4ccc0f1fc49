"""The command ``ctgraph-rl report``: one self-contained HTML page, the same in Markdown, and tables in LaTeX."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from ctgraph_rl import __version__, parsers
from ctgraph_rl.checks import require
from ctgraph_rl.disk import is_writable, make_folder, write_whole
from ctgraph_rl.learn.progress import Count, StepCounter, silent
from ctgraph_rl.log.escape import refused_by, terminal_text
from ctgraph_rl.log.files import METRICS, locked
from ctgraph_rl.report import formats, results
from ctgraph_rl.report.figures.adaptation import adaptation_curves
from ctgraph_rl.report.figures.aggregates import improvements, profiles
from ctgraph_rl.report.figures.gallery import CaptionedFigure, Gallery, Written
from ctgraph_rl.report.figures.heatmaps import MOST_NAMES, transfer_maps
from ctgraph_rl.report.figures.labels import label_strips
from ctgraph_rl.report.figures.learning_curves import (
    experiments,
    learning_curves,
    mean_curves,
    training_curves,
    unit_curves,
)
from ctgraph_rl.report.figures.life_windows import life_windows
from ctgraph_rl.report.figures.trees import Trees, find_trees, task_trees
from ctgraph_rl.report.latex import Table, as_cell, document
from ctgraph_rl.report.names import colours_of, displayed
from ctgraph_rl.report.sections import Result, Section, sections
from ctgraph_rl.report.style import MOST_AGENTS, require_packages, style
from ctgraph_rl.report.templates import rendered
from ctgraph_rl.report.terminal import code_notes, group_size, label_notes, mixed_code, print_problems, print_summary
from ctgraph_rl.runs.read import Problem, Run, find_runs, why_left_out
from ctgraph_rl.runs.settings import flat

OF_SECTION: tuple[Callable[[Section], CaptionedFigure | None], ...] = (
    *(life_windows, mean_curves, learning_curves),
    *(training_curves, unit_curves, adaptation_curves, label_strips, profiles, improvements),
)
"""Figures of all agents on a curriculum, in order; None for nothing to draw."""

OF_AGENT: tuple[Callable[[Section, Result, Trees], CaptionedFigure | None], ...] = (transfer_maps, task_trees)
"""Figures of an agent with finished runs, in order; None for nothing to draw."""

MOST_ROWS = 2000

MOST_SENTENCES = 10

MOST_COLUMNS = 10


TextRow = tuple[str, ...]


class Report(NamedTuple):
    """The page, its runs, and what could not be read."""

    page: Path
    runs: list[Run]
    problems: list[Problem]


class AgentPart(NamedTuple):
    """The part of the page on an agent."""

    result: Result
    figures: list[Written]
    numbers: dict[str, Table]  # matrices by their titles
    settings: list[tuple[str, Any]]
    sentences: list[str]


class Part(NamedTuple):
    """The part of the page on a curriculum."""

    section: Section
    facts: list[tuple[str, Any]]
    figures: list[Written]
    matrix: Table  # agents by the most important measures
    table: formats.Page  # the same, a line each
    everything: formats.Page | None  # the table of every measure
    agents: list[AgentPart]
    unshown: int  # agents without figures
    runs: list[TextRow]
    systems: list[tuple[str, int]]  # where the runs ran, and how many


def write_report(
    paths: Sequence[Path | str],
    folder: Path | str | None = None,
    agents: Sequence[str] = (),
    width: str = "text",
    colours: Sequence[str] = (),
    count: Count = silent,
    tuning: bool = False,
) -> Report:
    """Write ``report.html``, ``report.md``, ``tables.tex`` and ``figures/`` for all runs in or below some folders.

    Args:
        paths: run directories, or folders that hold them.
        folder: where the report goes; None: ``report`` within the one path, or, of several or a read-only one, within
            the working directory.
        agents: names and order of agents, as for `ctgraph_rl.report.names.displayed`.
        width: of figures: ``text`` of a page, or one of two columns, ``column``.
        colours: of agents, each as ``NAME=COLOUR``.
        count: called after each run, agent and figure.

    Raises:
        ModuleNotFoundError: before any work, without what the extra ``report`` installs.
        ValueError: if no run can be read, and for an unknown width, agent or colour.
        BlockingIOError: if another process writes into the folder.
    """
    require_packages()
    runs, problems = find_runs(paths, count, tuning)
    require((bool(runs), why_left_out(problems)))
    runs = displayed(runs, agents)
    chosen = colours_of(runs, colours)
    with style(width, chosen):
        pass  # refuses before any work
    if folder is None:
        within = len(paths) == 1 and is_writable(paths[0])
        folder = make_folder(Path(paths[0]) / "report" if within else Path("report"))
    found = sections(runs, count)
    num_agents = sum(min(len(section.results), MOST_AGENTS) for section in found)
    most = 1 + len(found) * len(OF_SECTION) + num_agents * len(OF_AGENT)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        gallery = Gallery(folder, width, chosen, lambda done: count("figures", done, most))
        together = gallery.write((), map(experiments, [found]))  # drawn in the gallery's style
        parts = [_part(section, gallery) for section in found]
        known: dict[str, tuple[str, str, str]] = {}
        shown: dict[str, None] = {}
        tables = []
        for part in parts:
            known |= part.section.definitions()
            tables.append(part.matrix)
            for agent in part.agents:
                shown[agent.result.agent] = None
                tables += agent.numbers.values() if len(part.section.labels) <= MOST_COLUMNS else ()
        who = ", ".join(shown) if len(shown) <= 3 else f"{len(shown)} agents"
        where = found[0].name if len(found) == 1 else f"{len(found)} curricula"
        page = folder / "report.html"
        for file in (page, page.with_suffix(".md")):
            text = rendered(
                Path(__file__).with_name(f"{file.name}.j2"),
                title=f"{where}: {who}",
                figures=together,
                smallest="44rem" if width == "text" else "0",
                parts=parts,
                problems=problems,
                code=[*mixed_code(runs), *code_notes(runs), *label_notes(runs)],
                legend=formats.LEGEND,
                legend_of_means=f"{formats.MEANS}; {formats.CI}",
                definitions=[(name, which, formula, source) for which, (name, formula, source) in known.items()],
                version=__version__,
                missing=[run for run in runs if run.reason is not None],
                num_runs=len(runs),
            )
            write_whole(file, text)
        write_whole(folder / "tables.tex", document(tables) + "\n")
    return Report(page, runs, problems)


def _part(section: Section, gallery: Gallery) -> Part:
    shown = results.selected(section.rows)
    modified = {section.name: section.modified} if section.modified else {}
    return Part(
        section,
        facts=list(facts(section)),
        figures=gallery.write((section.name,), (draw(section) for draw in OF_SECTION)),
        matrix=next(formats.matrices(shown, modified)),
        table=next(formats.pages(shown)),
        everything=next(formats.pages(section.rows)) if len(section.rows) <= MOST_ROWS else None,
        agents=[_agent(section, result, gallery) for result in section.results[:MOST_AGENTS]],
        unshown=max(0, len(section.results) - MOST_AGENTS),
        runs=list(chain(*map(_runs, section.results))),
        systems=Counter(map(_system, section.runs)).most_common(),
    )


def facts(section: Section) -> Iterator[tuple[str, Any]]:
    """Yield the facts of the learned curriculum."""
    about = section.one.about
    yield "curriculum", about["curriculum"]
    if section.modified:
        yield "modified", section.modified
    for name in ("version", "fingerprint", "source"):
        yield name, about.get(name, "not said")
    yield "tasks", len(section.labels)
    yield "blocks", len(section.trained)
    yield "frames", f"{section.ends[-1]:,}"
    if section.results[0].bounds.one_episode:
        yield (
            "a sample",
            "one seed: a greedy policy on deterministic tasks plays one episode again and again",
        )
    for group in ("curriculum", "evaluation", "protocol"):
        given = about["config"].get(group)
        for key, value in flat(given if isinstance(given, Mapping) else {}, f"{group}."):
            if value is not None and not key.endswith("_target_"):
                yield key, value


def _agent(section: Section, result: Result, gallery: Gallery) -> AgentPart:
    trees = find_trees(result.finished[0]) if result.finished else None
    drawn = () if trees is None else (draw(section, result, trees) for draw in OF_AGENT)
    figures = gallery.write((section.name, result.agent), drawn)
    missing = [f"Seed {seed} has no run." for seed, run in result.by_seed.items() if run is None]
    missing += [f"Seed {run.seed} has no results: {run.reason}." for run in result.runs if run.reason is not None]
    sentences = missing[:MOST_SENTENCES]
    if len(missing) > MOST_SENTENCES:
        more = len(missing) - MOST_SENTENCES
        sentences.append(f"{more} more seeds have no results; the list of runs says why.")
    if trees is not None and trees.reason:
        what = "Trees are" if trees.curriculum is None else "The policy on the trees is"
        sentences.append(f"{what} missing: {trees.reason}.")
    settings = list(result.runs[0].settings.items())
    return AgentPart(result, figures, _numbers(section, result), settings, sentences)


def _numbers(section: Section, result: Result) -> dict[str, Table]:
    if not result.finished or len(section.labels) > MOST_NAMES or "life" in section.one.about:
        return {}
    matrices = {"Mean return after each block": result.performance(), "Change by each block": result.transfer()}
    tables = {}
    for first, (title, matrix) in enumerate(matrices.items()):
        rows = []
        for block, estimates in enumerate(matrix, first):
            cells = []
            for estimate in estimates:
                complete = estimate.n in (0, len(result.finished))
                cells.append(as_cell(estimate.shown if complete else f"{estimate.shown} n = {estimate.n}"))
            rows.append((str(block), cells))
        caption = f"{section.name}, {result.agent} (n = {result.n}): {title}; {formats.MEANS}; {formats.CI}."
        label = f"{section.name} {result.agent} {title}"
        tables[title] = Table(caption, label, "block", section.labels, rows)
    return tables


def _runs(result: Result) -> Iterator[TextRow]:
    for seed, run in result.by_seed.items():
        if run is None:
            yield result.agent, str(seed), "no run", "", "", ""
        else:
            history = run.history
            progress = (f"{history.ends[-1]:,}", f"{history.seconds / 60:.1f}") if history else ("", "")
            yield result.agent, str(seed), run.reason or "finished", *progress, str(run.path)


def _system(run: Run) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in (run.about.get("versions") or {}).items())
    threads = run.about.get("num_threads", "?")
    device = run.about["config"].get("device", "not said")
    machine = run.about.get("machine", "not said")
    group = f"; trained in a group of {group_size(run)} seeds" if group_size(run) > 1 else ""
    return f"{versions or 'versions not said'}; machine {machine}, threads of torch {threads}, device {device}{group}"


def main() -> None:
    """Write the report, and say what is in it; the exit code is 1 if runs were left out or have different code."""
    parser = parsers.report()
    arguments = parser.parse_args()
    with refused_by(parser):
        if len(arguments.runs) == 1 and (arguments.runs[0] / METRICS).is_file():
            print_summary(arguments.runs[0])
        with StepCounter() as count:
            report = write_report(
                arguments.runs,
                arguments.out,
                arguments.agent,
                width=arguments.width,
                colours=arguments.colour,
                count=count,
                tuning=arguments.tuning,
            )
    incomplete = print_problems(report.problems, report.runs)
    num_runs = len(report.runs)
    print(f"report of {num_runs} run{'s' * (num_runs != 1)}: {terminal_text(report.page)}")
    if incomplete:
        sys.exit(1)


if __name__ == "__main__":
    main()
