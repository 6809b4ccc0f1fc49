"""A card for each published curriculum: pictures, who can solve it, tables, command, results and how to cite it."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

from bibliography import entries_of
from results_of import curriculum_results
from short_runs import sentence_of, study_of
from yaml_settings import ALONE, CONF, escaped, settings_of, table

import curricula
from baselines.parts.catalogue import catalogue
from baselines.parts.inner_loop import InnerLoop
from ctgraph_rl import Curriculum, Task
from ctgraph_rl.describe import Sheet, describe, to_markdown
from ctgraph_rl.tasks.task import are_graphs
from ctgraph_rl.tasks.values import random_frames_to_goal

MANY = 16
"""Tasks from which on the tables of a card are folded."""

NO_RUN = "No run yet: `ctgraph-rl -m experiment=every_curriculum` has short ones."
"""What a card says of a curriculum without results."""


def curriculum_cards(figures: dict[str, dict[str, str]]) -> Iterator[tuple[str, str]]:
    """Yield the path and the text of each card, and of the list of them, in Markdown.

    Args:
        figures: by name and kind the files with the drawings of each curriculum, in ``generated/figures``.
    """
    all_curricula = {name: curricula.load(name) for name in curricula.names()}
    yield "curricula/index.md", _index(all_curricula)
    for name, curriculum in all_curricula.items():
        yield f"curricula/{name}.md", card(curriculum, **figures.get(name, {}))


def _index(all_curricula: dict[str, Curriculum]) -> str:
    head = [
        "| curriculum | version | fingerprint | tasks | frames | tasks that need memory | what it is |",
        "|---|--:|---|--:|--:|--:|---|",
    ]
    rows = [
        f"| [`{name}`]({name}.md) | {c.version} | {c.fingerprint} | {len(c.tasks):,} | {c.num_frames:,} "
        f"| {_need_memory(c)} | {_purpose(name)} |"
        for name, c in all_curricula.items()
    ]
    words = "Every curriculum with a name. Run one with `ctgraph-rl curriculum=NAME`."
    listing = "\n".join([*head, *rows])
    return f"# Curriculum cards\n\n{words}\n\n{listing}\n"


def _purpose(name: str) -> str:
    return escaped(curricula.summary(name)).replace("``", "`")


def _need_memory(curriculum: Curriculum) -> str:
    needs = [needs_memory(task) for task in curriculum.tasks] if are_graphs(curriculum.tasks) else [None]
    return "not known" if None in needs else f"{sum(map(bool, needs)):,}"


@cache
def needs_memory(task: Task) -> bool | None:
    """Return whether policies without memory fall short of the optimal return; None where that is not known."""
    try:
        return task.memoryless_ceiling(deterministic=True) < task.optimal_value(1.0) - 1e-9
    except ValueError:
        return None


def card(curriculum: Curriculum, graphs: str = "", similarity: str = "", curves: str = "") -> str:
    """Return a card in Markdown; ``graphs``, ``similarity`` and ``curves`` are the files of its figures, if any."""
    name = curriculum.name
    overview, *sheets = describe(curriculum)
    results = [study_of(name) or sentence_of(curriculum) or NO_RUN]
    results += [f"![Mean return of short runs of {name}](../figures/{curves})"] if curves else []
    results.append(curriculum_results(name))
    parts = [
        ALONE,
        f"# `{name}`",
        "[All curricula](index.md)",
        _purpose(name),
        *([f"![The graphs of {name}, and where the goals are](../figures/{graphs})"] if graphs else []),
        to_markdown(overview).split("\n\n", 1)[1].strip(),  # without its title
        f"```bash\nctgraph-rl curriculum={name}\n```",
        f'```python\nimport curricula\n\ncurriculum = curricula.load("{name}")\n```',
        *(_of_graphs(curriculum, similarity) if are_graphs(curriculum.tasks) else []),
        *_folded(sheets, len(curriculum.tasks)),
        *_settings(name),
        "## Results",
        *filter(None, results),
        "## Cite",
        f"Name the curriculum as `{name}`, version {curriculum.version} ({curriculum.fingerprint}), of ctgraph_rl.",
        *(f"```bibtex\n{entry}\n```" for entry in entries_of(curriculum.source)),
    ]
    return "\n\n".join(parts) + "\n"


def _of_graphs(curriculum: Curriculum, similarity: str) -> list[str]:
    """Return what is known of CT-graphs alone."""
    return [
        "## Who can solve it",
        "\n".join(f"- {sentence}" for sentence in _who(curriculum)),
        "## How similar its tasks are",
        f"![Similarity of the tasks of {curriculum.name}](../figures/{similarity})",
    ]


def _folded(sheets: list[Sheet], tasks: int) -> list[str]:
    """Return the other tables of the description, folded where they are long."""
    tables = [to_markdown(sheet).strip() for sheet in sheets]
    if tasks <= MANY:
        return tables
    lead = f"<details><summary>Tables of all {tasks:,} tasks</summary>"
    return ["## Tables", lead, *(text.replace("## ", "### ", 1) for text in tables), "</details>"]


def _settings(name: str) -> list[str]:
    settings = settings_of(f"curriculum/{name}") if (CONF / "curriculum" / f"{name}.yaml").is_file() else []
    words = "A run with another value is reported as modified."
    return ["## Settings", words, table(settings, "curriculum.")] if settings else []


def _who(curriculum: Curriculum) -> Iterator[str]:
    """Yield sentences on what an agent needs to solve the curriculum."""
    yield _of_memory(curriculum.tasks)
    hardest = max(curriculum.tasks, key=random_frames_to_goal)
    frames, longest = random_frames_to_goal(hardest), max(block.num_frames for block in curriculum.blocks)
    needed = f"{frames:,.0f}" if frames < 1e7 else f"{frames:.1e}"
    label = escaped(dict(zip(curriculum.tasks, curriculum.labels, strict=True))[hardest])
    yield (
        f"Exploration: on {label}, the hardest task for it, a random policy first reaches the goal after "
        f"{needed} frames on average; the longest block has {longest:,}."
    )
    if curriculum.protocol.task_id == "hidden" and _conflicts(curriculum.tasks):
        yield (
            "Task ids are hidden, and some tasks with the same graph and images have different goals: no single "
            "policy solves all tasks at once, so what was learned first is overwritten."
        )


def _of_memory(tasks: tuple[Task, ...]) -> str:
    needs = [needs_memory(task) for task in tasks]
    with_memory, without = (_agents(memory) for memory in (True, False))
    if None in needs:
        return "Memory: whether it is needed has no closed form here."
    if not any(needs):
        return f"Memory: not needed, so agents without memory can solve it, too: {without}."
    which = "every task" if all(needs) else f"{sum(map(bool, needs)):,} of {len(tasks):,} tasks"
    return f"Memory: needed for {which}, so only agents with memory can solve it: {with_memory}."


@cache
def _agents(memory: bool) -> str:
    """Names of agents that remember an episode, or that do not: an inner loop remembers earlier episodes only."""
    names = [e.name for e in catalogue("agent") if (e.kind.memory and not issubclass(e.kind, InnerLoop)) == memory]
    return ", ".join(f"[`{name}`](../agents/{name}.md)" for name in names)


def _conflicts(tasks: tuple[Task, ...]) -> bool:
    """Whether two tasks look the same and have different goals."""
    return len({(t.graph, t.images, t.observations) for t in tasks}) < len(
        {(t.graph, t.images, t.observations, t.goal) for t in tasks}
    )
