"""A task's graph in the DOT language of Graphviz, written without Graphviz."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from ctgraph_rl.core.graph import WAIT_ACTION, StateType
from ctgraph_rl.draw.layout import DECISION, END, FAIL, FAIL_KEY, HOME, HOME_KEY, WAIT, Key, lay_out, write_ids
from ctgraph_rl.draw.style import colour
from ctgraph_rl.log.escape import terminal_lines
from ctgraph_rl.tasks.task import Task

MOST_LEAVES = 1024

SHAPES: Mapping[StateType, str] = {HOME: "house", WAIT: "circle", DECISION: "diamond", END: "box", FAIL: "octagon"}


def to_dot(task: Task, name: str = "") -> str:
    """Return all states with the ids they show, and all transitions with their actions; the goal has a double line.

    Beyond 1,024 end states only the path to the goal is written, with one node for the other branches of each decision
    state.
    """
    return "\n".join(["digraph {", *(f"  {line};" for line in _statements(task, name)), "}", ""])


def _statements(task: Task, name: str) -> Iterator[str]:
    goal = task.graph.node_at(task.goal)
    layout = lay_out(task.graph, [goal], MOST_LEAVES)
    b = task.graph.branching_factor
    p = task.graph.wait_prob
    yield _attributes("graph", label=name, labelloc="t")
    yield _attributes("node", style="filled", fontname="sans-serif")
    for state in (*layout.states(), FAIL_KEY):
        kind, node = state
        rings = {"peripheries": "2"} if state == (END, goal) else {}
        text = write_ids(task, state, layout.level[node])
        yield _attributes(_name(state), label=text, shape=SHAPES[kind], fillcolor=colour(kind), **rings)
    for start, end, action in layout.edges(task):
        yield _attributes(f"{_name(start)} -> {_name(end)}", label="any" if start == HOME_KEY else str(action))
    for state in layout.states():
        if state[0] == WAIT and p > 0:
            yield _attributes(f"{_name(state)} -> {_name(state)}", label=f"{WAIT_ACTION} (p={p:g})")
        if state[0] in (WAIT, DECISION):
            wrong = f"1..{b}" if state[0] == WAIT else str(WAIT_ACTION)
            yield _attributes(f"{_name(state)} -> {_name(FAIL_KEY)}", label=wrong, style="dashed")
    for node, left_out in layout.left_out.items():
        yield _attributes(f"more{node}", label=f"{left_out:,} more branches", shape="plaintext", style="")
        yield f"{_name((DECISION, node))} -> more{node}"


def _name(state: Key) -> str:
    return f"{state[0].name.lower()}{state[1]}"


def _attributes(what: str, **values: str) -> str:
    return f"{what} [{', '.join(f'{key}={_quote(value)}' for key, value in values.items())}]"


def _quote(text: str) -> str:
    escaped = terminal_lines(text).replace("\\", "\\\\").replace('"', '\\"')
    return '"' + escaped.replace("\n", "\\n") + '"'
