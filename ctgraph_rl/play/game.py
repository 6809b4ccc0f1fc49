"""A person plays a CT-graph in the terminal and sees what an agent sees, or watches a policy.

``ctgraph-rl play CT-SU-B1``, ``ctgraph-rl play --run RUN --task 2 --delay 0.5``. Without a terminal, keys are read from
lines.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TextIO

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.style import Style
from rich.text import Text
from rich.tree import Tree

from ctgraph_rl import parsers
from ctgraph_rl.checks import at_least_one, is_real, require
from ctgraph_rl.core.dynamics import OUTCOME_FAIL, OUTCOME_GOAL, OUTCOME_OTHER_END
from ctgraph_rl.core.graph import StateType
from ctgraph_rl.draw.layout import lay_out
from ctgraph_rl.log.escape import refused_by
from ctgraph_rl.play.arguments import select
from ctgraph_rl.play.player import Player
from ctgraph_rl.tasks.images import white_level
from ctgraph_rl.tasks.task import Task

SHADES = " .:-=+*#%@"
WIDTH = 24
"""Least columns of an image; pixels of a small one are repeated."""
VECTOR_COLUMNS = 16
MOST_BRANCHES = 16
MOST_KEYS = 9
"""Largest action that one key names; others are typed as lines."""
END_OF_INPUT = "\x04"

OUTCOMES = {
    OUTCOME_FAIL: "a wrong action: fail",
    OUTCOME_OTHER_END: "an end state without the goal",
    OUTCOME_GOAL: "the goal",
}
RULES = """You see what an agent sees: one image at a time. Behind it is a tree with {d} decisions in a row,
{b} branches at each, and waiting before and after. At home any action leads on. A wait state wants action 0,
again and again if need be; a decision state wants one of 1..{b}. Anything else fails.
One of {leaves:,} end states is the goal."""


class Game:
    """A player, its results so far, and the console that shows them."""

    def __init__(self, player: Player, console: Console) -> None:
        self.player = player
        self.console = console
        self.graph = player.task.graph
        self.episodes = self.successes = 0
        self.is_over = False

    def begin(self) -> None:
        """Start an episode and show its first observation."""
        self.player.start()
        self.is_over = False
        self._show("a new episode")

    def press(self, key: str) -> None:
        """Act on a key."""
        if key == "?":
            self.console.print(self.truth())
        elif key == "r":
            self.begin()
        elif not (key.isdecimal() and int(key) <= self.graph.branching_factor):
            self._say(f"unknown key {key!r}: {self._keys()}")
        elif self.is_over:
            self._say("The episode is over: r begins another, q quits.")
        else:
            self.act(int(key))

    def act(self, action: int | None = None) -> None:
        """Take a step, with the policy's action if there is none, and show the result."""
        self.is_over = self.player.step(action)
        self._show(f"after action {self.player.action}")
        if self.is_over:
            data = self.player.data
            outcome = int(data["outcome"])
            self.episodes += 1
            self.successes += outcome == OUTCOME_GOAL
            result = f"return {float(data['episode_reward']):g} in {int(data['step_count'])} steps"
            self._say(f"{OUTCOMES[outcome]}; {result}")
            self._say(f"{self.score()}. r begins another, q quits.")

    def _show(self, what: str) -> None:
        if self.console.is_terminal:
            self.console.clear()
        image = self.player.data["observation"][0].numpy()
        self.console.print(picture(image, white_level(self.player.task.images), has_colours(self.console)))
        step = int(self.player.data["step_count"])
        self._say(f"step {step}, {what}." + ("" if self.is_over else f" {self._keys()}"))

    def _say(self, words: str) -> None:
        self.console.print(Text(words), soft_wrap=True)

    def _keys(self) -> str:
        return f"0..{self.graph.branching_factor} act, r restarts, ? shows the tree, q quits"

    def score(self) -> str:
        """Return how often the goal was reached, and how often random actions reach it."""
        share = f", {self.successes / self.episodes:.0%}" if self.episodes else ""
        p_random = self.graph.reward_prob_random
        times = f", 1 in {1 / p_random:,.0f}" if p_random else ""
        return (
            f"goal in {self.successes} of {self.episodes} episodes{share}; random actions: P_R = {p_random:.3g}{times}"
        )

    def truth(self) -> Tree:
        """The tree, with the goal and the player's place."""
        env = self.player.env
        return truth(self.player.task, StateType(int(env.state_type)), int(env.node), int(env.goal_leaf))


def truth(task: Task, kind: StateType, place: int, goal_leaf: int) -> Tree:
    """Return a tree as text, with the goal and a place; of a large one the paths to both."""
    graph = task.graph
    goal = graph.num_decision_states + goal_leaf
    layout = lay_out(graph, [goal, place], MOST_BRANCHES)
    root = Tree(Text("home" + (_here(kind) if kind == StateType.HOME else "")))
    drawn: dict[int, Tree] = {}
    for node in layout.x:
        label = f"{task.decision_to(node)}: " if node else ""
        label += f"{layout.kind(node).name.lower()} state" + (", the goal" if node == goal else "")
        at_node = node == place and kind != StateType.HOME
        above = drawn[graph.parent(node)] if node else root
        drawn[node] = above.add(Text(label + (_here(kind) if at_node else "")))
    for node, left_out in layout.left_out.items():
        drawn[node].add(f"{left_out:,} more branches")
    return root


def _here(kind: StateType) -> str:
    words = {StateType.WAIT: "you wait before it", StateType.FAIL: "you failed here"}
    return f"  <- {words.get(kind, 'you are here')}"


def has_colours(console: Console) -> bool:
    """Return whether a console can show blocks of grey."""
    plain = console.no_color or console.color_system is None
    return not plain and console.encoding.lower().startswith("utf")


def picture(observation: NDArray[np.uint8], white: float, colours: bool) -> Text:
    """Return an observation in greys, two pixels a character cell one above the other, or in shades of ASCII.

    Args:
        observation: uint8 [1, r, r], or [K] for a vector, shown in lines of 16.
    """
    if observation.ndim == 3:
        image = observation[0]
    else:
        columns = min(len(observation), VECTOR_COLUMNS)
        image = np.pad(observation, (0, -len(observation) % columns)).reshape(-1, columns)
    levels = np.clip(image.astype(int) * 255 // int(white), 0, 255)
    times = max(1, WIDTH // levels.shape[1])
    if colours:
        return _blocks(levels.repeat(times, 0).repeat(times, 1))
    times = max(1, times // 2)
    shown = (levels * len(SHADES) // 256).repeat(times, 0).repeat(2 * times, 1)
    return Text("\n".join("".join(SHADES[level] for level in line) for line in shown.tolist()) + "\n")


def _blocks(levels: NDArray[np.int_]) -> Text:
    levels = np.pad(levels, ((0, len(levels) % 2), (0, 0)))
    text = Text()
    for upper, lower in zip(levels[::2], levels[1::2], strict=True):
        for high, low in zip(upper.tolist(), lower.tolist(), strict=True):
            text.append("▀", Style(color=f"rgb({high},{high},{high})", bgcolor=f"rgb({low},{low},{low})"))
        text.append("\n")
    return text


@contextmanager
def keyboard(stream: TextIO, largest_action: int) -> Iterator[Iterator[str]]:
    """Yield pressed keys, or words of lines without a terminal or with more actions than digits.

    The terminal is restored in any case.
    """
    if not stream.isatty() or largest_action > MOST_KEYS or os.name != "posix":
        yield (word for line in stream for word in line.split())
        return
    import termios
    import tty

    device = stream.fileno()
    before = termios.tcgetattr(device)
    try:
        tty.setcbreak(device)
        yield iter(lambda: os.read(device, 1).decode(errors="replace") or END_OF_INPUT, END_OF_INPUT)
    finally:
        termios.tcsetattr(device, termios.TCSADRAIN, before)


def play(game: Game, keys: Iterable[str]) -> None:
    """Let a person play until the keys end or one quits."""
    graph = game.graph
    rules = RULES.format(b=graph.branching_factor, d=graph.depth, leaves=graph.num_end_states)
    game.begin()
    game.console.print(Text(rules), soft_wrap=True)
    for key in keys:
        if key == "q":
            return
        game.press(key)


def watch(game: Game, episodes: int, delay: float) -> None:
    """Show a policy's episodes and the tree behind them, with a pause of ``delay`` seconds after each step."""
    for _ in range(episodes):
        game.begin()
        while not game.is_over:
            time.sleep(delay)
            game.act()
            game.console.print(game.truth())
        time.sleep(delay)


def main(argv: Sequence[str] | None = None) -> None:
    """The command line, ``ctgraph-rl play``."""
    parser = parsers.play()
    arguments = parser.parse_args(argv)
    with refused_by(parser):
        require(
            (is_real(arguments.delay, 0), f"--delay must be seconds >= 0, got {arguments.delay}"),
            *at_least_one(episodes=arguments.episodes),
        )
        selection = select(arguments)
        game = Game(selection.player(arguments.seed, not arguments.sampled), Console(highlight=False))
    try:
        if selection.policy is not None:
            watch(game, arguments.episodes, arguments.delay)
        else:
            with keyboard(sys.stdin, game.graph.branching_factor) as keys:
                play(game, keys)
    except KeyboardInterrupt:
        print()
    game.console.print(Text(game.score()), soft_wrap=True)


if __name__ == "__main__":
    main()
