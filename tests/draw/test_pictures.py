"""Pictures of tasks, the command that makes them, and the page that shows them."""

import json
import os
import re
import shlex
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.paths import CHECKOUT
from helpers.reference_files import SHIPPED_2023
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

import curricula
from ctgraph_rl import cli
from ctgraph_rl.core.graph import StateType
from ctgraph_rl.draw.image_figure import image_figure
from ctgraph_rl.draw.style import new_figure
from ctgraph_rl.draw.task_figure import draw_task, task_figure
from ctgraph_rl.play.pictures import main
from ctgraph_rl.play.visits import visits
from ctgraph_rl.policies import NavigationPolicy, RandomPolicy
from ctgraph_rl.tasks.configurations import ct_co_b1, ct_fo_b1, ct_fo_b2, ct_su_b1, make_task
from ctgraph_rl.tasks.images import ImageFile

HOME, WAIT, DECISION, END, FAIL = StateType

DOCS = CHECKOUT / "docs"
PAGES = [DOCS / "how-to" / "draw_and_play.md", DOCS / "explanation" / "ct_graph_in_pictures.md"]
TEXT = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
LINES = [line for block in re.findall(r"```bash\n(.*?)```", TEXT, re.DOTALL) for line in block.splitlines()]
COMMANDS = [line for line in dict.fromkeys(LINES) if "describe" not in line and not line.endswith(" kinds.png")]


def axes_of(task, **overlays):
    """The axes of a picture that was drawn."""
    figure = task_figure(task, **overlays)
    figure.canvas.draw()
    return figure.axes[0]


def words_in_nodes(axes) -> list[str]:
    """The texts above everything else, by place from top left to bottom right, fail last."""
    texts = [text for text in axes.texts if text.get_zorder() == 4]
    return [text.get_text() for text in sorted(texts, key=lambda t: (t.get_text() == "", -t.get_position()[1]))]


def edge_colours(axes) -> dict:
    """The colours of edges by their end, as (x, y) rounded."""
    lines = next(collection for collection in axes.collections if isinstance(collection, LineCollection))
    ends = [tuple(np.round(segment[1], 3)) for segment in lines.get_segments()]
    return dict(zip(ends, lines.get_colors()[:, :3].sum(1).round(3).tolist(), strict=True))


@pytest.mark.parametrize(
    ("task", "shown"),
    [
        (ct_fo_b1(), [str(number) for number in range(16)]),
        (ct_su_b1(), ["0", "1", *["2"] * 3, *["3"] * 7, *["4"] * 4]),
        (ct_co_b1(), ["0", "1", *["103"] * 4, *["2"] * 3, *["3-102"] * 7]),
    ],
    ids=["full", "surjective", "confounding"],
)
def test_nodes_have_the_ids_of_what_they_show(task, shown):
    assert sorted(words_in_nodes(axes_of(task))) == sorted(shown)


def test_without_ids_nodes_have_the_initials_of_their_kinds():
    words = words_in_nodes(axes_of(make_task(branching_factor=3, depth=2), ids=False))

    assert sorted(words) == sorted("H" + "F" + "D" * 4 + "W" * 13 + "E" * 9)


def test_every_kind_of_state_has_a_shape_and_a_colour_of_its_own():
    axes = axes_of(ct_fo_b2())

    marks = [line for line in axes.lines if line.get_linestyle() == "None" and line.get_zorder() == 3]
    looks = {(line.get_marker(), line.get_markerfacecolor()) for line in marks}
    assert {marker for marker, _ in looks} == set("poDs8*")
    assert len({colour for _, colour in looks}) == 6
    assert [line.get_marker() for line in marks].count("*") == 1


def test_the_star_is_below_the_goal():
    axes = axes_of(ct_fo_b1((2, 1)))

    (star,) = [line for line in axes.lines if line.get_marker() == "*" and line.get_zorder() == 3]
    (x,), (y,) = star.get_data()
    assert (x, y) == (0.625, -6)


def test_wait_states_have_a_ring_where_waiting_may_stay():
    def rings(task):
        lines = [line for line in axes_of(task).lines if line.get_markerfacecolor() == "none"]
        return sum(len(line.get_xdata()) for line in lines)

    assert (rings(ct_fo_b1()), rings(ct_fo_b2())) == (0, 15)


def test_the_way_to_the_goal_is_black_and_the_rest_grey():
    colours = edge_colours(axes_of(ct_fo_b1((2, 1))))

    way = [(0.5, -1), (0.5, -2), (0.75, -3), (0.75, -4), (0.625, -5), (0.625, -6)]
    assert len(colours) == 14
    assert [place for place, colour in colours.items() if colour == 0] == way


def test_the_likeliest_action_is_black():
    policies = [{(DECISION, 0): [0.1, 0.2, 0.7]}, {(DECISION, 0): torch.tensor([0.1, 0.2, 0.7])}]

    black = [
        [place for place, colour in edge_colours(axes_of(ct_fo_b1(), policy=policy)).items() if colour == 0]
        for policy in policies
    ]

    assert black == [[(0.75, -3)]] * 2


def test_probabilities_stand_at_the_edges():
    policy = {(DECISION, 0): [0.25, 0.5, 0.25], (WAIT, 0): [0.9, 0.1, 0]}

    words = {text.get_text() for text in axes_of(ct_fo_b1(), policy=policy).texts}

    assert {"1: 0.50", "2: 0.25", "0: 0.90"} <= words
    assert {"0.25", "0.10"} <= words  # what fails


def test_actions_above_b_count_as_failing():
    policy = {(DECISION, 0): [0.1, 0.2, 0.3, 0.4], (WAIT, 0): [0, 0, 0, 1]}

    words = [text.get_text() for text in axes_of(ct_fo_b1(), policy=policy).texts]

    assert {"0.50", "1.00", "0: 0.00", "2: 0.30"} <= set(words)


def test_visits_stand_in_the_nodes():
    counts, actions = visits(ct_fo_b1(), NavigationPolicy, num_episodes=100)

    words = words_in_nodes(axes_of(ct_fo_b1(), visits=counts, policy=actions))

    ends = [counts.get((END, node), 0) for node in range(3, 7)]
    assert sum(ends) == 100
    assert sorted(words) == sorted([*map(str, counts.values()), "0"])  # none failed
    many = {(HOME, 0): 1_000_000, (WAIT, 0): 12_345, (DECISION, 0): 9_999}
    assert {"1M", "12k", "9999", "0"} == set(words_in_nodes(axes_of(ct_fo_b1(), visits=many)))


@pytest.mark.parametrize("shape", [(2, 2), (3, 2), pytest.param((2, 7), marks=pytest.mark.slow)], ids=str)
def test_numbers_do_not_overlap_each_other(shape):
    b, d = shape
    task = make_task(branching_factor=b, depth=d, wait_prob=0.5, fully_observable=False)
    counts, actions = visits(task, NavigationPolicy, num_episodes=300)
    axes = axes_of(task, visits=counts, policy=actions)

    boxes = [text.get_window_extent().shrunk(0.9, 0.9) for text in axes.texts if text.get_text()]

    assert len(boxes) > 20
    assert not any(one.overlaps(other) for i, one in enumerate(boxes) for other in boxes[:i])


def test_a_large_graph_is_a_summary_that_says_so():
    task = make_task(branching_factor=5, depth=8, goal=(3,) * 8, fully_observable=False)
    counts = {(END, task.graph.num_decision_states + leaf): 100 - leaf for leaf in range(20)}

    axes = axes_of(task, visits=counts)

    summary = "8 of 390,625 end states drawn, wait states left out"
    assert axes.get_title() == f"b=5, d=8, p=0, goal 3.3.3.3.3.3.3.3\n{summary}"
    labels = [text.get_text() for text in axes.texts if re.fullmatch("[1-5](.[1-5]){7}", text.get_text())]
    ends = ["1.1", "1.2", "1.3", "1.4", "1.5", "2.1", "2.2"]
    assert labels == [*(f"1.1.1.1.1.1.{end}" for end in ends), "3.3.3.3.3.3.3.3"]


@pytest.mark.parametrize("shape", [(2, 1), (40, 1), (2, 6), (1000, 3), (2, 60)], ids=str)
def test_a_graph_of_any_shape_is_drawn(shape, tmp_path):
    b, d = shape
    task = make_task(branching_factor=b, depth=d, wait_prob=0.3, fully_observable=False)

    task_figure(task).savefig(tmp_path / "a.png")

    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_a_small_panel_leaves_numbers_out():
    figure = Figure(figsize=(2, 2))
    axes = figure.subplots()
    counts, actions = visits(ct_fo_b2(), RandomPolicy, num_episodes=10)

    draw_task(axes, ct_fo_b2(), counts, actions, legend=False)

    assert axes.get_legend() is None
    assert [text.get_text() for text in axes.texts if ":" in text.get_text()] == []


def test_the_legend_of_a_tree_fits_a_figure_of_one_column():
    figure = new_figure(3.5, 4)
    axes = figure.subplots()

    draw_task(axes, ct_su_b1())
    figure.canvas.draw()

    box = axes.get_legend().get_window_extent()
    assert 0 <= box.x0 < box.x1 <= figure.bbox.width


def test_the_images_of_each_kind_of_state_are_shown():
    (axes,) = image_figure(ct_fo_b1()).axes

    words = [text.get_text() for text in axes.texts]
    kinds = ["home", "0", "wait", *"2345678", "decision", "9", "10", "11", "end", "12", "13", "14", "15", "fail", "1"]
    assert words == kinds
    places = [axes.texts[words.index(kind)].get_position() for kind in ("home", "wait")]
    assert places == [(-0.06, -0.5), (-0.06, -1.72)]
    ids = [int(word) for word in words if word.isdecimal()]
    for number, image in zip(ids, axes.images, strict=True):
        assert np.array_equal(image.get_array(), ct_fo_b1().images.images[number].numpy())


def test_observations_of_an_id_vary_by_noise_around_its_image():
    task = make_task("CT-CO-B1", read_noise=40)

    (axes,) = image_figure(task).axes

    labels = ["home 0", "wait 3", "wait 4", "wait 5", "decision 2", "end 103", "fail 1"]
    assert [text.get_text() for text in axes.texts][::9] == labels
    images = [image.get_array().astype(int) for image in axes.images]
    for label, (first, *reads) in zip(labels, zip(*[iter(images)] * 8, strict=True), strict=True):
        assert np.array_equal(first, task.images.images[int(label.split()[1])].numpy())
        noises = [np.where(first < 200, read - first, 20) for read in reads]
        assert all(noise.min() >= 0 and noise.max() <= 40 for noise in noises)
        assert len({read.tobytes() for read in reads}) == 7


def test_an_id_with_several_instances_is_shown_by_its_first_and_drawn_ones(tmp_path):
    array = np.arange(10, dtype=np.uint8).reshape(5, 2, 1, 1).repeat(4, 2).repeat(4, 3)
    np.save(tmp_path / "images.npy", array)

    (axes,) = image_figure(replace(ct_su_b1(), images=ImageFile.of(tmp_path / "images.npy"))).axes

    levels = [int(image.get_array()[0, 0]) for image in axes.images]
    assert levels[::8] == [0, 6, 4, 8, 2]  # home 0, wait 3, decision 2, end 4, fail 1
    assert set(levels[1:8]) == {0, 1}


def test_vectors_are_shown_as_lines():
    (axes,) = image_figure(make_task(branching_factor=2, depth=2, one_hot=True)).axes

    assert [image.get_array().tolist()[0].index(1) for image in axes.images][:3] == [0, 2, 3]
    assert axes.images[0].get_array().shape == (1, 16)


def test_names_on_the_command_line(tmp_path, monkeypatch):
    def label(*words: str) -> str:
        main([*words, "--dot", str(tmp_path / "a.dot")])
        return re.search('label="(.*?)"', (tmp_path / "a.dot").read_text())[1]

    (tmp_path / "graph.json").write_text(json.dumps(SHIPPED_2023))
    monkeypatch.chdir(tmp_path)

    assert label("ct-fo-b2", "--goal", "2.1.1") == "CT-FO-B2, goal 2.1.1"
    assert label("--depth", "3", "--branching-factor", "12", "--surjective", "--goal", "12.1.1") == (
        "CT-graph, goal 12.1.1"
    )
    assert label("graph.json", "--goal", "2.1") == "graph.json, goal 2.1"
    assert label("ct8", "--task", "3") == f"ct8, task 3: {curricula.load('ct8').labels[2]}"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "nothing to write: name a --figure, --dot or --gif"),
        (["CT-FO-B3", "--dot", "a"], "unknown configuration 'CT-FO-B3': did you mean 'CT-FO-B2'?"),
        (["ct88", "--dot", "a"], "unknown curriculum 'ct88'; did you mean 'ct8'?"),
        (["ct8", "--task", "9", "--dot", "a"], "--task must be in 1..8, the tasks of ct8, got 9"),
        (["ct8", "--depth", "2", "--dot", "a"], "the tasks of a curriculum cannot be changed here: ct8 takes no depth"),
        (
            ["none.json", "--goal", "1.1", "--dot", "a"],
            "none.json cannot be opened: no such file or directory; check the path",
        ),
        (["CT-FO-B1", "--goal", "1.x", "--dot", "a"], "goal must be 2 decisions in 1..2, such as 1.1, got 1.x"),
        (["CT-FO-B1", "--goal", "3.1", "--dot", "a"], "goal must be 2 decisions in 1..2, such as 1.1, got 3.1"),
        (["CT-FO-B1", "--goal", "0.1", "--dot", "a"], "counts from 0: use 1.2"),
        (["CT-FO-B1", "--gif", "a.gif"], "a film needs a policy: name a --policy or a --run"),
        (["CT-FO-B1", "--figure", "a.xyz"], "Format 'xyz' is not supported"),
        (
            ["CT-FO-B1", "--figure", "no/such/a.png"],
            "cannot write no/such/a.png: there is no folder no/such; make it first",
        ),
        (["CT-FO-B1", "--figure", "a.png", "--dpi", "0"], "dpi must be an integer >= 1, got 0"),
        (["CT-FO-B1", "--run", "a", "--dot", "a"], "--run names the curriculum: choose its task with --task"),
        (["--run", "nowhere", "--dot", "a"], "nowhere holds no run"),
        (["CT-FO-B1", "--dot", "a", "--policy", "best"], "invalid choice: 'best'"),
    ],
)
def test_an_error_is_one_message_and_nothing_is_written(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    with pytest.raises(SystemExit) as exit_:
        main(words)

    assert exit_.value.code == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("ending", "start"), [("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_figures_are_written_in_the_format_of_their_name(tmp_path, ending, start):
    path = tmp_path / f"a.{ending}"

    main(["CT-FO-B1", "--policy", "random", "--episodes", "10", "--figure", str(path)])

    assert path.read_bytes().startswith(start)


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.split()[-1])
def test_the_commands_of_the_page_run_and_make_its_pictures(command, tmp_path, monkeypatch, capsys):
    from PIL import Image

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", shlex.split(command))

    cli.main()

    for made in tmp_path.glob("*.[pg][ni][gf]"):
        with Image.open(made) as new, Image.open(DOCS / "pictures" / made.name) as stored:
            assert new.size == stored.size
            difference = np.abs(np.asarray(new.convert("L"), int) - np.asarray(stored.convert("L"), int))
            assert difference.mean() < 2  # fonts may differ in small ways


def test_the_pages_pictures_are_made_by_its_commands_and_small():
    shown = re.findall(r"!\[.*?\]\(\.\./pictures/(.*?)\)", TEXT)

    made = [command.split()[-1] for command in COMMANDS]
    stored = {path.name: path.stat().st_size for path in (DOCS / "pictures").iterdir()}
    assert set(shown) == set(stored) <= set(made)
    assert max(stored.values()) < 60_000


@pytest.mark.slow
def test_a_backend_that_is_not_there_matters_to_no_figure(tmp_path):
    program = (
        "import os, sys\nfrom ctgraph_rl.report.style import new_figure, require_packages, style\n"
        "require_packages()\nwith style():\n    new_figure(1, 1).savefig(sys.argv[1])\n"
        "assert os.environ['MPLBACKEND'] == 'nonsense'"
    )
    env = {**os.environ, "MPLBACKEND": "nonsense"}

    done = subprocess.run([sys.executable, "-c", program, str(tmp_path / "a.png")], capture_output=True, env=env)

    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.png").stat().st_size > 0
