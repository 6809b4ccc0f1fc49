"""Playing in the terminal: what is shown and told, with lines as keys, on a terminal, and with a policy."""

import io
import os
import re
import signal
import sys
import threading
import time

import numpy as np
import pytest
from rich.console import Console

from ctgraph_rl import cli
from ctgraph_rl.core.graph import StateType
from ctgraph_rl.play.game import SHADES, Game, has_colours, keyboard, main, picture, truth
from ctgraph_rl.play.player import Player
from ctgraph_rl.policies import OptimalPolicy
from ctgraph_rl.tasks.configurations import ct_fo_b1, make_task

TO_GOAL_12 = "0 0 1 0 2 0"


@pytest.fixture
def play(monkeypatch, capsys):
    """Plays with lines as keys; gives all that is printed."""

    def play_(keys: str, *words: str) -> str:
        monkeypatch.setattr(sys, "stdin", io.StringIO(keys))
        main(words)
        return capsys.readouterr().out

    return play_


def lines_of(tree) -> list[str]:
    """A tree as text."""
    console = Console(file=io.StringIO(), width=100)
    console.print(tree)
    return console.file.getvalue().splitlines()


def test_each_episode_is_told_with_its_outcome_and_the_share_of_goals(play):
    out = play(f"{TO_GOAL_12}\nr 0 0 1 0 1 0\nr 0 1\nq\n", "CT-SU-B1", "--goal", "1.2")

    results = re.findall(r"^(.*); return (.*) in (\d+) steps\n(goal in .*?)\.? r begins", out, re.MULTILINE)
    assert [result[:3] for result in results] == [
        ("the goal", "1", "6"),
        ("an end state without the goal", "0", "6"),
        ("a wrong action: fail", "0", "2"),
    ]
    luck = "random actions: P_R = 0.00412, 1 in 243"
    shares = ["1 of 1 episodes, 100%", "1 of 2 episodes, 50%", "1 of 3 episodes, 33%"]
    assert [result[3] for result in results] == [f"goal in {share}; {luck}" for share in shares]


def test_keys_that_mean_nothing_change_nothing(play):
    out = play(f"0 x 3 -1 ٣ ² 0 1 0 2 0 0 2\n{''}r\n", "CT-SU-B1", "--goal", "1.2")

    assert [key in out for key in ("'x'", "'3'", "'-1'")] == [True] * 3
    assert out.count("unknown key") == 5
    assert "the goal; return 1 in 6 steps" in out
    assert out.count("The episode is over: r begins another, q quits.") == 2
    assert out.count("step 0, a new episode") == 2


def test_an_episode_that_is_restarted_does_not_count(play):
    out = play(f"0 0 r {TO_GOAL_12}", "CT-SU-B1", "--goal", "1.2")

    assert "goal in 1 of 1 episodes" in out


def test_the_end_of_the_input_ends_the_game(play):
    assert play("", "CT-SU-B1").endswith("goal in 0 of 0 episodes; random actions: P_R = 0.00412, 1 in 243\n")


def test_more_actions_than_digits_are_typed_as_words(play):
    out = play("0 0 12 0\n", "--branching-factor", "12", "--depth", "1", "--surjective", "--goal", "12")

    assert "the goal; return 1 in 4 steps" in out


def test_nothing_tells_the_state_but_the_question_mark(play):
    hidden = play("0 0 1 0", "CT-SU-B1")
    told = play("0 0 1 0 ?", "CT-SU-B1")

    assert not re.search(r"you are here|you wait|home\n", hidden)
    assert "1: decision state  <- you are here" in told
    assert (
        told.replace(
            "\n".join(lines_of(truth(make_task(branching_factor=2, depth=2), StateType.DECISION, 1, 0))) + "\n", ""
        )
        == hidden
    )


def test_the_truth_is_the_tree_with_goal_and_position():
    assert lines_of(truth(make_task(branching_factor=2, depth=1), StateType.WAIT, 2, 0)) == [
        "home",
        "└── decision state",
        "    ├── 1: end state, the goal",
        "    └── 2: end state  <- you wait before it",
    ]
    assert lines_of(truth(make_task(branching_factor=2, depth=1), StateType.HOME, 0, 1))[0] == "home  <- you are here"
    assert (
        "1: end state, the goal  <- you failed here"
        in lines_of(truth(make_task(branching_factor=2, depth=1), StateType.FAIL, 1, 0))[2]
    )


def test_the_truth_of_a_large_tree_is_short():
    task = make_task(branching_factor=1000, depth=4, fully_observable=False)

    lines = lines_of(truth(task, StateType.DECISION, 5, 10**12 - 1))

    assert len(lines) == 1 + 1 + 1 + 4 + 5  # home, root, two ways, what is left out
    assert sum("the goal" in line for line in lines) == sum("you are here" in line for line in lines) == 1
    assert [line for line in lines if "998 more branches" in line] == lines[-1:]


@pytest.mark.parametrize(
    ("options", "coloured"),
    [
        ({"force_terminal": True, "color_system": "truecolor", "no_color": False}, True),
        ({"force_terminal": True, "color_system": "truecolor", "no_color": True}, False),
        ({"force_terminal": False}, False),
    ],
)
def test_greys_need_a_terminal_with_colours(options, coloured):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")

    assert has_colours(Console(file=stream, **options)) == coloured


def test_a_terminal_without_unicode_gets_shades():
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")

    assert not has_colours(Console(file=stream, force_terminal=True, color_system="truecolor"))


def test_shades_are_two_characters_for_each_pixel():
    image = np.array([[[0, 254], [127, 200]]], np.uint8).repeat(6, 1).repeat(6, 2)

    lines = picture(image, 254, colours=False).plain.splitlines()

    assert lines == [" " * 12 + "@" * 12] * 6 + [SHADES[4] * 12 + SHADES[7] * 12] * 6


def test_blocks_have_the_grey_of_two_pixels():
    image = np.zeros((1, 25, 24), np.uint8)
    image[0, 0], image[0, 1], image[0, 24] = 254, 127, 254

    text = picture(image, 254, colours=True)

    styles = [span.style for span in text.spans]
    assert len(text.plain.splitlines()) == 13
    assert (styles[0].color.triplet.red, styles[0].bgcolor.triplet.red) == (255, 127)
    assert (styles[-1].color.triplet.red, styles[-1].bgcolor.triplet.red) == (255, 0)


def test_a_vector_is_shown_in_lines_of_sixteen():
    vector = np.zeros(20, np.uint8)
    vector[17] = 1

    lines = picture(vector, 1, colours=False).plain.splitlines()

    assert lines == [" " * 32, "  @@" + " " * 28]


def test_a_policy_is_watched_with_what_is_behind_its_images(play):
    out = play("", "CT-FO-B1", "--goal", "2.1", "--policy", "optimal", "--episodes", "2", "--delay", "0")

    assert out.count("the goal; return 1 in 6 steps") == 2
    assert out.count("<- you are here") + out.count("<- you wait before it") == 2 * 6
    assert "after action 2." in out
    assert out.endswith("goal in 2 of 2 episodes, 100%; random actions: P_R = 0.00412, 1 in 243\n")


def test_a_game_is_told_on_the_console_it_is_given():
    console = Console(file=io.StringIO(), width=80)
    game = Game(Player(ct_fo_b1(), OptimalPolicy), console)

    game.begin()
    while not game.is_over:
        game.act()

    assert (game.episodes, game.successes) == (1, 1)
    assert game.score() == "goal in 1 of 1 episodes, 100%; random actions: P_R = 0.00412, 1 in 243"
    assert console.file.getvalue().count("step ") == 7


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["CT-XX-B1"], "unknown configuration 'CT-XX-B1': did you mean 'CT-SU-B1'?"),
        (["CT-FO-B1", "--policy", "optimal", "--delay", "-1"], "--delay must be seconds >= 0, got -1.0"),
        (["CT-FO-B1", "--policy", "optimal", "--episodes", "0"], "episodes must be an integer >= 1, got 0"),
        (["CT-FO-B1", "--seed", "-1"], "seed must be"),
    ],
)
def test_an_error_is_one_message(words, message, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(words)

    assert exit_.value.code == 2
    assert message in capsys.readouterr().err


def test_the_console_script_knows_the_command(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["ctgraph-rl", "play", "CT-SU-B1"])
    monkeypatch.setattr(sys, "stdin", io.StringIO("q"))

    cli.main()

    assert "step 0, a new episode" in capsys.readouterr().out


posix = pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are of POSIX")


def play_in_a_terminal() -> None:
    """Play in this process, which has a terminal as its standard streams, and say whether that is restored."""
    import termios

    os.environ.update(TERM="xterm-256color", COLORTERM="truecolor")
    os.environ.pop("NO_COLOR", None)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where the tests run in the background
    before = termios.tcgetattr(0)
    sys.stdin = open(0, closefd=False)  # noqa: SIM115, until the process ends
    sys.stdout = sys.stderr = open(1, "w", closefd=False)  # noqa: SIM115, as above
    main(["CT-SU-B1", "--goal", "1.2"])
    print("RESTORED", termios.tcgetattr(0) == before, flush=True)


@posix
def test_on_a_terminal_keys_need_no_return_and_it_is_as_before_in_the_end():
    pty, termios = pytest.importorskip("pty"), pytest.importorskip("termios")
    person, terminal = pty.openpty()
    before = termios.tcgetattr(terminal)

    with open(terminal, closefd=False) as stream:
        with keyboard(stream, 2) as keys:
            os.write(person, b"0?\x04")
            pressed, during = list(keys), termios.tcgetattr(terminal)
        after = termios.tcgetattr(terminal)
        with pytest.raises(KeyboardInterrupt), keyboard(stream, 2):
            raise KeyboardInterrupt

    assert pressed == ["0", "?"]
    assert during != before and after == termios.tcgetattr(terminal) == before


@posix
def test_an_interrupt_ends_the_game_cleanly():
    import pty

    child, terminal = pty.fork()
    if child == 0:
        code = 1
        try:
            play_in_a_terminal()
            code = 0
        finally:
            os._exit(code)
    told = bytearray()

    def listen() -> None:
        try:
            while part := os.read(terminal, 65536):
                told.extend(part)
        except OSError:  # the child has gone
            pass

    def wait_for(words: bytes) -> None:
        patience = time.monotonic() + 120
        while words not in told:
            assert time.monotonic() < patience, bytes(told[-500:])
            time.sleep(0.02)

    listener = threading.Thread(target=listen, daemon=True)
    listener.start()
    wait_for(b"end states is the goal")
    for count, key in enumerate(TO_GOAL_12.split(), 1):
        os.write(terminal, key.encode())
        wait_for(b"step %d" % count)
    wait_for(b"goal in 1 of 1 episodes")
    os.write(terminal, b"\x03")

    _, status = os.waitpid(child, 0)
    listener.join(120)

    assert status == 0
    assert "▀".encode() in told and b"38;2;" in told
    assert b"RESTORED True" in told
