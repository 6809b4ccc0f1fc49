"""The pages of the Python API: which names and modules stand on which page."""

from __future__ import annotations

from collections.abc import Iterator

import ctgraph_rl

EXPORTED = {
    "curricula": ("tasks.curriculum", "tasks.protocol"),
    "tasks": ("core", "tasks"),
    "environments": ("env", "batch"),
    "learning": ("agent", "learn", "log", "runs"),
}
"""For each page, the folders and modules of ``ctgraph_rl`` whose exported names it documents; the first counts."""

ELSEWHERE = "learning"
"""The page of exported names from other modules."""

PAGES: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "environments": (
        "Environments",
        "The same tasks for TorchRL, Gymnasium and Stable-Baselines3, and the batch of rows behind them.",
        (
            "ctgraph_rl.gym",
            "ctgraph_rl.sb3",
            "ctgraph_rl.policies",
        ),
    ),
    "tasks": (
        "Graphs, tasks and observations",
        "What a task is made of, and the numbers that follow from it.",
        (
            "ctgraph_rl.tasks.configurations",
            "ctgraph_rl.core.rewards",
            "ctgraph_rl.tasks.memory",
            "ctgraph_rl.tasks.curriculum:Stream",
            "ctgraph_rl.tasks.images.image_set",
            "ctgraph_rl.tasks.switch",
            "ctgraph_rl.tasks.values",
            "ctgraph_rl.tasks.similarity",
            "ctgraph_rl.tasks.observability",
            "ctgraph_rl.tasks.kinds.gym_spaces:ObservationForm,Taken",
        ),
    ),
    "learning": (
        "Learning, logs and runs",
        "Learn a curriculum, evaluate policies, record and load runs.",
        (
            "ctgraph_rl.agent",
            "ctgraph_rl.learn.lifelong",
            "ctgraph_rl.learn.loop:Progress,Group",
            "ctgraph_rl.learn.labels",
            "ctgraph_rl.learn.histories:Tree",
            "ctgraph_rl.learn.collective",
            "ctgraph_rl.learn.messages",
            "ctgraph_rl.log.tables",
            "ctgraph_rl.log.scores",
            "ctgraph_rl.runs.read",
            "ctgraph_rl.runs.trackers",
            "ctgraph_rl.compare",
        ),
    ),
    "curricula": (
        "Curricula",
        "Published sequences by name, and functions that make others.",
        ("curricula", "curricula.axes", "curricula.configured", "curricula.meta_json"),
    ),
    "metrics": (
        "Metrics",
        "Functions of performance matrices and curves; each metric also has a card.",
        (
            "ctgraph_rl.metrics",
            "ctgraph_rl.metrics.record",
            "ctgraph_rl.metrics.bounds",
            "ctgraph_rl.metrics.matrix",
            "ctgraph_rl.metrics.curves",
            "ctgraph_rl.metrics.transfer",
            "ctgraph_rl.metrics.lifetime",
            "ctgraph_rl.metrics.optimum",
            "ctgraph_rl.metrics.regimes",
            "ctgraph_rl.metrics.labels",
            "ctgraph_rl.metrics.adaptation",
            "ctgraph_rl.metrics.windows",
        ),
    ),
    "figures": (
        "Figures and reports",
        "Draw tasks, curricula and policies, and report runs.",
        (
            "ctgraph_rl.draw.task_figure",
            "ctgraph_rl.draw.curriculum_figure",
            "ctgraph_rl.draw.similarity_figure",
            "ctgraph_rl.draw.image_figure",
            "ctgraph_rl.play.visits",
            "ctgraph_rl.play.player",
            "ctgraph_rl.play.gif",
            "ctgraph_rl.draw.dot",
            "ctgraph_rl.report.page:write_report,Report",
            "ctgraph_rl.report.statistics",
            "ctgraph_rl.report.intervals",
        ),
    ),
    "engines": (
        "Engines",
        "The pure functions of tensors that make every step, and the two engines that call them for a batch of rows.",
        (
            "ctgraph_rl.core.dynamics",
            "ctgraph_rl.core.row_params",
            "ctgraph_rl.core.tree",
            "ctgraph_rl.batch.params",
            "ctgraph_rl.batch.assignment",
            "ctgraph_rl.batch.tensor_engine",
            "ctgraph_rl.batch.native",
        ),
    ),
    "baselines": (
        "Baselines",
        "What agents and lifelong-learning methods are built from.",
        (
            "baselines.parts.learner",
            "baselines.parts.hooks",
            "baselines.parts.policy_gradient",
            "baselines.parts.q_learning",
            "baselines.parts.recurrent_q",
            "baselines.rl2:TrialTrunk",
            "baselines.parts.networks",
            "baselines.parts.inner_loop:InnerModel,Played",
            "baselines.parts.gates:GatedNetwork",
            "baselines.update.update:UpdateState,update,Parts,make_optimiser,has_parts,parts_of,minimise,step",
            "baselines.parts.embedding",
            "baselines.cells.cell:Units",
            "baselines.parts.transport",
            "baselines.methods.method",
            "baselines.methods.parts.importance",
            "baselines.methods.parts.masks",
            "baselines.methods.parts.heads",
            "baselines.methods.parts.weights",
        ),
    ),
}
"""For each page its title, a sentence, and the modules that it documents: whole, or those names after a colon."""


FIRST = "CTGraphEnv"
"""The name that the API opens with."""


def exported(page: str) -> list[str]:
    """Return the names that ``ctgraph_rl`` exports and a page documents."""
    names = [name for name in ctgraph_rl.__all__ if name != "metrics" and _page_of(name) == page]
    return sorted(names, key=FIRST.__ne__)


def _page_of(name: str) -> str:
    home = _home(name).removeprefix("ctgraph_rl.")
    return next((page for page, homes in EXPORTED.items() if home.startswith(homes)), ELSEWHERE)


def _home(name: str) -> str:
    """Return the module that an exported name is defined in."""
    return getattr(getattr(ctgraph_rl, name), "__module__", "")


def api_pages() -> Iterator[tuple[str, str]]:
    """Yield the path and the text of each page, in reStructuredText."""
    yield "api/index.rst", _index()
    for page, (title, sentence, modules) in PAGES.items():
        parts = [_title(title, "="), sentence, *map(_directive, exported(page))]
        yield f"api/{page}.rst", "\n\n".join([*parts, *map(_module, modules)]) + "\n"


def _index() -> str:
    pages = "\n".join(f"   {page}" for page in PAGES)
    words = "Everything that a script imports. ``import ctgraph_rl`` is cheap: names are imported when they are used."
    return f"{_title('Python API', '=')}\n\n{words}\n\n.. toctree::\n   :maxdepth: 2\n\n{pages}\n"


def _title(text: str, underline: str) -> str:
    return f"{text}\n{underline * len(text)}"


def _directive(name: str) -> str:
    """Return the directive that documents an exported name."""
    if isinstance(getattr(ctgraph_rl, name), type):
        return f".. autoclass:: ctgraph_rl.{name}\n   :members:"
    return f".. autofunction:: ctgraph_rl.{name}"


def _module(entry: str) -> str:
    """Return a section with what a module defines, without what ``ctgraph_rl`` exports of it."""
    name, _, members = entry.partition(":")
    left_out = [each for each in ctgraph_rl.__all__ if _home(each) == name]
    options = [f"   :members: {members}", *([f"   :exclude-members: {', '.join(left_out)}"] if left_out else [])]
    return "\n".join([_title(f"``{name}``", "-"), "", f".. automodule:: {name}", *options])
