"""What is said of a curriculum before any run: closed forms against the environment's chain, words, tables, figures."""

import builtins
import math
from dataclasses import replace

import pytest
from helpers.oracles import confounding, fully_observable, one_hot, surjective
from rich.console import Console

import curricula
from ctgraph_rl.batch.params import make_shared_bank
from ctgraph_rl.describe import (
    MOST_SHOWN,
    describe,
    evaluation_in_words,
    listing,
    memory,
    print_sheet,
    protocol_in_words,
    to_latex,
    to_markdown,
)
from ctgraph_rl.draw.curriculum_figure import draw_graphs, goals_by_graph
from ctgraph_rl.log import sheets
from ctgraph_rl.log.sheets import Sheet
from ctgraph_rl.tasks.curriculum import Curriculum, Stream
from ctgraph_rl.tasks.protocol import Block, Evaluation, Protocol
from ctgraph_rl.tasks.switch import Drift
from ctgraph_rl.tasks.task import are_graphs
from curricula.__main__ import main

A, B = surjective(goal=(1, 1)), surjective(goal=(1, 2))


def make(*blocks: Block, **parts: object) -> Curriculum:
    return Curriculum("made", 3, "tests", blocks or (Block(A, 64), Block(B, 128)), **parts)


def test_more_frames_than_a_float_holds_are_shown_as_infinite():
    assert "inf" in describe(make(Block(surjective(2, 60, 1 - 2**-53), 1)))[2].rows[0]


@pytest.mark.parametrize(
    "tasks",
    [(A, B), (A, surjective(image_seed=2)), (confounding(read_rotation=3), confounding()), (one_hot(), one_hot(3))],
)
def test_memory_is_what_the_environment_holds(tasks):
    bank, per_row = memory(make(*(Block(task, 1) for task in tasks)))

    held = make_shared_bank(tasks, 1, 0)
    assert bank == held.images.numel()
    assert per_row == 2 * math.prod(held.shape)


def test_the_overview_says_what_a_reader_asks_for():
    overview = dict(describe(make(), frames_per_second=10)[0].rows)

    assert overview["version"] == "3"
    assert overview["fingerprint"] == make().fingerprint
    assert overview["frames"] == "192"
    assert overview["memory"] == "720 bytes of images, and 288 for each row"
    assert overview["time"] == "19.2 seconds at 10 frames/s; 0.137 seconds for evaluations, estimated"
    with pytest.raises(ValueError, match="frames_per_second must be a number > 0, got 0"):
        describe(make(), frames_per_second=0)


@pytest.mark.parametrize(
    ("rate", "time"), [(192, "1 seconds"), (1, "3.2 minutes"), (0.01, "5.33 hours"), (0.0001, "22.2 days")]
)
def test_times_have_a_unit_that_fits(rate, time):
    assert dict(describe(make(), rate)[0].rows)["time"].startswith(f"{time} at ")


def test_an_estimate_counts_every_moment_step_and_row_of_the_evaluations():
    """A step takes 5 ms, and 13 us a row: 81 moments (0, 10, ..., 800 frames), 6 steps, 2 tasks x 100 episodes."""
    evaluation = Evaluation(before=True, every=10)
    curriculum = replace(make(Block(A, 400), Block(B, 400)), evaluation=evaluation)

    seconds = 81 * 6 * (5e-3 + 13e-6 * 200)
    shown = dict(describe(curriculum, frames_per_second=10)[0].rows)["time"]

    assert f"; {seconds:.3g} seconds for evaluations" in shown


def test_the_protocol_is_said_in_words():
    announced = " A new block ends all episodes and is announced."

    assert protocol_in_words(Protocol(), 4) == "The learner does not observe its task." + announced
    assert protocol_in_words(Protocol("one_hot", "hidden"), 4) == (
        "Every observation comes with a one-hot task id of length 4. "
        "A row changes to the next block when its episode ends, without notice."
    )
    assert "where a block begins and where it is evaluated" in protocol_in_words(Protocol("at_boundaries"), 4)


def test_the_evaluation_is_said_in_words():
    often = Evaluation(10, False, 5, before=False, every=2000, tasks="seen", held_out=(A,))

    assert evaluation_in_words(Evaluation()) == (
        "100 greedy episodes on each of all tasks: before training, at block ends."
    )
    assert evaluation_in_words(often) == (
        "10 sampled episodes, 5 in a row on each of the tasks seen so far and 1 held out: "
        "every 2,000 frames, at block ends."
    )


def test_blocks_are_rows_with_one_for_each_task():
    sheet = describe(make(Block(A, 2000), Block((A, B, A), 30)))[1]

    assert list(sheet.columns) == ["block", "task", "b", "d", "p", "goal", "frames"]
    assert sheet.rows == (
        ("1", "goal1.1", "2", "2", "0", "1.1", "2,000"),
        ("2", "goal1.1", "2", "2", "0", "1.1", "30"),
        ("", "goal1.2", "2", "2", "0", "1.2", ""),
    )


def test_a_switch_has_a_column():
    sheet = describe(make(Block((A, B), 30, Drift(9)), Block(A, 1)))[1]

    assert [row[-1] for row in sheet.rows] == ["Drift(episodes=9, together=False)", "", ""]
    assert list(sheet.columns)[-1] == "switch"


def test_tasks_have_their_closed_forms_and_ceilings():
    _, _, sizes, ceilings, _ = describe(make())

    closed = ("16", "4", "0.004115", "0.01646", "0.25", "6", "2.5", "651")
    assert sizes.rows == (("goal1.1", *closed), ("goal1.2", *closed))
    assert ceilings.rows == (("goal1.1", "1", "1", "1", "1"), ("goal1.2", "1", "0", "0.25", "1"))
    assert ceilings.notes[-1].startswith("No memory is needed for goal1.1: a deterministic policy without memory is")


def test_goals_that_change_are_not_said_to_need_no_memory():
    (*_, changing, _), (*_, instances, _), (*_, plain, _) = (
        describe(curricula.load(name)) for name in ("su_b1_changing_goals", "su_b1_instances", "su_b1_4tasks")
    )

    assert changing.notes[-1].startswith("Goals change: the ceilings are those of a goal that is known and stays.")
    assert instances.notes[-2].startswith("Noise and rotation on read may serve a deterministic policy as dice")
    assert [len(sheet.notes) for sheet in (changing, instances, plain)] == [4, 5, 4]


def test_what_an_agent_without_memory_loses_is_said_of_each_task_that_needs_it():
    def notes(name: str) -> list[str]:
        ceilings = describe(curricula.load(name))[3]
        return [note for note in ceilings.notes if note.startswith("Memory is needed")]

    assert notes("su_b1_4tasks")[0].endswith("reaches at most 0 of 1 in goal1.2, 0 of 1 in goal2.1.")
    assert notes("fo_b1_4tasks") == []


def test_fully_observable_tasks_are_not_said_to_need_no_memory():
    ceilings = describe(make(Block(fully_observable(), 1)))[3]

    assert ceilings.rows[0][1:] == ("1",) * 4
    assert not [note for note in ceilings.notes if note.startswith("No memory")]


def test_observations_have_what_they_leave_open_and_what_varies():
    noisy = replace(confounding(read_rotation=5, read_noise=10), reward_std=0.1)

    rows = describe(make(Block((A, noisy, fully_observable()), 1)))[4].rows

    assert rows[0][1:] == ("7/3/4", "0.5012", "1.822", "0.965", "0", "0 deg", "0")
    assert rows[1][1] == "7/3/4"
    assert rows[1][5:] == ("0..10", "0..5 deg", "0.1")
    assert rows[2][1:5] == ("1/1/1", "0", "0", "0")


def test_observations_of_shared_unique_ids_are_not_known_and_say_why():
    full = fully_observable(3)
    legacy = replace(full, observations=replace(full.observations, legacy_index=True))

    sheet = describe(make(Block(legacy, 1)))[4]

    assert sheet.rows[0][1:5] == ("-",) * 4
    assert "not a legacy_index with branching_factor=3" in sheet.notes[-1]


def test_table_2_of_the_paper_has_all_its_rows_in_one_command(capsys):
    main(["probabilities", "--format", "markdown"])

    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if line.startswith("| b=")] == [
        "| b=2, d=1, p=0 | 3.70e-02 | 7.41e-02 | 1/2 | 8 | 2 |",
        "| b=2, d=2, p=0.9 | 1.20e-05 | 4.80e-05 | 1/4 | 16 | 4 |",
        "| b=3, d=2, p=0.9 | 2.10e-06 | 1.89e-05 | 1/9 | 28 | 9 |",
        "| b=2, d=4, p=0.9 | 3.02e-09 | 4.84e-08 | 1/16 | 64 | 16 |",
        "| b=3, d=10, p=0.9 | 3.75e-23 | 2.22e-18 | 1/59049 | 177148 | 59049 |",
        "| b=2, d=16, p=0.5 | 3.04e-20 | 2.00e-15 | 1/65536 | 262144 | 65536 |",
    ]


def test_a_ceiling_that_is_not_known_says_why_once():
    tasks = (replace(A, step_reward=-0.1), replace(B, step_reward=-0.1))

    sheet = describe(make(*(Block(task, 1) for task in tasks)))[3]

    assert [row[1:4] for row in sheet.rows] == [("0.4", "-", "-")] * 2
    reasons = [note for note in sheet.notes if note.startswith("-: ")]
    assert reasons == [
        "-: the memoryless ceiling is exact only for step_reward = 0, where a longer episode is worth no more, got -0.1"
    ]


ODD = Sheet("a_b & [c]", {"x_1": "l", "E[rho]": "r"}, (("_a|b*\\\n", "1"), ("50% <#>$~^{}", '"')), ("note_1 |",))


def test_markdown_shows_texts_as_they_are():
    assert to_markdown(ODD).splitlines() == [
        r"## a_b &amp; \[c\]",
        "",
        r"| x_1 | E\[rho\] |",
        "| :-- | --: |",
        r"| \_a\|b\*\\ | 1 |",
        r'| 50% &lt;#&gt;\$\~^{} | " |',
        "",
        r"note_1 \|",
    ]


def test_latex_shows_texts_as_they_are():
    assert to_latex(ODD).splitlines() == [
        "% a_b & [c]",
        "% note_1 |",
        r"\begin{tabular}{lr}",
        r"\toprule",
        r"x\_1 & $E[\rho]$ \\",
        r"\midrule",
        r"\_a\textbar{}b{*}\textbackslash{} & 1 \\",
        r"50\% \textless{}\#\textgreater{}\$\textasciitilde{}\textasciicircum{}\{\} & \textquotedbl{} \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]


def test_a_long_column_is_broken_in_latex():
    sheet = Sheet("t", {"a": "l", "b": "l"}, (("x", "y" * (sheets.WIDE + 1)),))

    assert r"\begin{tabular}{lp{0.6\linewidth}}" in to_latex(sheet)


def test_the_terminal_shows_every_cell_and_note_without_markup():
    console = Console(record=True, width=80, file=open("/dev/null", "w"))  # noqa: SIM115

    print_sheet(ODD, console)

    text = console.export_text()
    assert all(word in text for word in ("a_b & [c]", "E[rho]", "50% <#>$~^{}", "note_1 |"))


@pytest.mark.parametrize("name", curricula.names())
def test_every_named_curriculum_can_be_described(name):
    curriculum = curricula.load(name)

    overview, blocks, *of_tasks = sheets = describe(curriculum)

    assert overview.title == name
    shown = MOST_SHOWN if isinstance(curriculum, Stream) else len(curriculum.blocks)
    assert len(blocks.rows) == sum(map(len, curriculum.trained[:shown]))
    known = 3 if are_graphs(curriculum.examples) else 0
    assert [len(sheet.rows) for sheet in of_tasks] == [len(curriculum.examples)] * known
    assert all(len(row) == len(sheet.columns) for sheet in sheets for row in sheet.rows)


def test_the_listing_has_a_row_for_each():
    assert listing([make()]).rows == (("made", "3", "2", "192", make().fingerprint, "tests"),)


def test_goals_are_gathered_by_graph_with_their_blocks():
    wide, deep = surjective(12, 1, goal=(11,)), surjective(2, 20, goal=(1,) * 20)
    blocks = (
        Block(A, 1),
        Block((A, B, surjective(image_seed=2)), 3),
        Block(wide, 1),
        Block(A, 1),
        Block(deep, 1),
        *[Block(B, 1)] * 3,
    )

    goals = goals_by_graph(make(*blocks))

    assert goals == {
        A.graph: {(1, 1): "1.1\nblocks 1, 2, 4", (1, 2): "1.2\n4 blocks"},
        wide.graph: {(11,): "11\nblock 3"},
        deep.graph: {(1,) * 20: "1.1.1.1 ... 1.1.1.1\nblock 5"},
    }


@pytest.mark.parametrize(
    "shapes",
    [
        [(2, 2)],
        [(3, 11), (30, 1), (1000, 2)],
        pytest.param([(2, d) for d in range(1, 15)], marks=pytest.mark.slow),
    ],
)
def test_graphs_of_any_size_are_drawn(tmp_path, shapes):
    blocks = [Block(surjective(b, d, goal=goal), 1) for b, d in shapes for goal in ((1,) * d, (2,) * d)]

    draw_graphs(make(*blocks), tmp_path / "graphs.png")

    assert (tmp_path / "graphs.png").read_bytes().startswith(b"\x89PNG")


def boxes_of_labels(curriculum: Curriculum, monkeypatch: pytest.MonkeyPatch) -> list[list]:
    """Where the labels of each panel are, in pixels."""
    drawn = []
    monkeypatch.setattr("ctgraph_rl.draw.curriculum_figure.save_figure", lambda figure, _: drawn.append(figure))
    draw_graphs(curriculum, "unused.png")
    (figure,) = drawn
    figure.canvas.draw()
    return [[text.get_window_extent() for text in axes.texts] for axes in figure.axes]


@pytest.mark.parametrize("shape", [(2, 2), (2, 3), (2, 5), (3, 3), (2, 11)], ids=str)
def test_labels_of_goals_do_not_overlap(monkeypatch, shape):
    b, d = shape
    goals = [tuple(1 + leaf // b**k % b for k in reversed(range(d))) for leaf in range(min(b**d, 40))]
    curriculum = make(*(Block(surjective(b, d, goal=goal), 1) for goal in goals))

    (boxes,) = boxes_of_labels(curriculum, monkeypatch)

    assert len(boxes) == (8 if b**d > 32 else len(goals))
    assert not any(one.overlaps(other) for i, one in enumerate(boxes) for other in boxes[:i])


def test_a_figure_without_matplotlib_names_the_extra(tmp_path, monkeypatch):
    import_ = builtins.__import__

    def without(name: str, *rest: object) -> object:
        if name.startswith("matplotlib"):
            raise ModuleNotFoundError(name)
        return import_(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)

    with pytest.raises(ModuleNotFoundError, match=r"figures need matplotlib: pip install 'ctgraph_rl\[plot\]'"):
        draw_graphs(make(), tmp_path / "graphs.png")
