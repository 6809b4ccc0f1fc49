"""What figures of the report show, as drawn: numbers that can be read, and marks that are whole."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace

import pytest
from helpers.made_runs import write_run

from ctgraph_rl.report.sections import mean_curve, sections
from ctgraph_rl.runs.read import find_runs

pytest.importorskip("matplotlib")

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb

from ctgraph_rl.report.figures import heatmaps
from ctgraph_rl.report.figures.heatmaps import draw_matrices
from ctgraph_rl.report.figures.labels import label_strips
from ctgraph_rl.report.figures.learning_curves import learning_curves, mean_curves, training_curves, unit_curves
from ctgraph_rl.report.style import ink, style
from ctgraph_rl.report.terminal import label_notes


@pytest.fixture
def section(tmp_path):
    """Three seeds of an agent, whose values go over the whole scale and beyond 1."""
    for seed, value in enumerate((0.3, 0.5, 0.7)):
        write_run(tmp_path / f"{seed}", seed=seed, performance=((0.0, math.nan), (1.5, value), (1 - value, 0.9)))
    return sections(find_runs([tmp_path])[0])[0]


def contrast(one, other) -> float:
    """The contrast ratio of two colours, by the Web Content Accessibility Guidelines 2.2."""
    dark, light = sorted(map(luminance, (one, other)))
    return (light + 0.05) / (dark + 0.05)


def luminance(colour) -> float:
    red, green, blue = [each / 12.92 if each <= 0.04045 else ((each + 0.055) / 1.055) ** 2.4 for each in colour]
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def test_without_returns_of_training_there_is_no_figure_of_them(section, tmp_path):
    write_run(tmp_path / "untrained" / "0", intervals=0)
    untrained = sections(find_runs([tmp_path / "untrained"])[0])[0]

    assert training_curves(section) is not None
    assert training_curves(untrained) is None


@pytest.mark.parametrize("colours", ["viridis", "PuOr"])
def test_numbers_on_every_colour_of_a_map_have_a_contrast_of_at_least_4_5(colours):
    shades = [mpl.colormaps[colours](i)[:3] for i in range(256)]

    assert min(contrast(shade, to_rgb(ink(shade))) for shade in shades) >= 4.5


def test_each_number_is_written_in_the_ink_of_its_own_cell(section):
    with style():
        figure = draw_matrices(section, section.results[0])

    for axes in figure.axes[:2]:
        (image,) = axes.images
        for text in axes.texts:
            column, row = text.get_position()
            value = image.get_array()[row, column]
            shade = axes.get_facecolor() if math.isnan(value) else image.to_rgba(value)
            assert contrast(shade[:3], to_rgb(text.get_color())) >= 4.5
        assert len(axes.texts) == image.get_array().size


@pytest.mark.parametrize("draw", [mean_curves, learning_curves])
def test_no_marker_is_cut_at_the_edge_of_its_panel(section, draw):
    with style():
        figure = draw(section).figure
        FigureCanvasAgg(figure).draw()

    for axes in figure.axes:
        box = axes.get_window_extent()
        for line in axes.lines:
            if line.get_marker() in ("", "None"):
                continue
            radius = line.get_markersize() / 2 * figure.dpi / 72
            for x, y in axes.transData.transform(line.get_xydata()):
                assert box.x0 <= x - radius and x + radius <= box.x1
                assert box.y0 <= y - radius and y + radius <= box.y1


def test_the_mean_over_all_tasks_is_of_evaluations_of_all_of_them(section):
    history = section.results[0].finished[0].history

    curve = mean_curve(history)

    assert [frames for frames, _ in curve] == [0, 1000, 2000]
    assert math.isnan(curve[0][1])
    assert [value for _, value in curve[1:]] == pytest.approx([0.9, 0.8])


def test_few_seeds_are_thin_lines_beside_their_mean_and_no_band(section):
    with style():
        (axes,) = mean_curves(section).figure.axes

    widths = sorted(line.get_linewidth() for line in axes.lines if line.get_linestyle() == "-")

    assert widths == [0.4, 0.4, 0.4, 1.4]
    assert not axes.collections


def test_labels_are_drawn_over_the_frames_in_which_they_acted_in_the_colour_of_their_task(tmp_path):
    acted = [(1, 1, 0), (1, 1, 0), (1, 1, 1), (2, 0, 0), (3, 1, 0), (3, 1, 0), (3, 1, 0), (3, 1, 0)]
    write_run(tmp_path / "0", agent="A", intervals=4, acted=acted)
    write_run(tmp_path / "1", agent="B")
    section = sections(find_runs([tmp_path])[0])[0]

    with style():
        figure = label_strips(section).figure
    (axes,) = figure.axes

    bars = [(*bar.get_xy(), bar.get_width(), bar.get_facecolor()) for bar in axes.patches]
    first, second = bars[0][3], bars[1][3]
    assert first[:3] != second[:3]
    assert [bar[0] for bar in bars] == [0, 1000, 0, 750, 1000]
    assert [bar[2] for bar in bars] == [1000, 1000, 750, 250, 1000]
    assert [bar[3][:3] for bar in bars[2:]] == [first[:3], first[:3], second[:3]]
    assert bars[3][3][3] < bars[2][3][3] == 1  # not learned from: pale
    assert [text.get_text() for text in axes.texts] == ["1", "2", "1", "2", "3"]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["true task", "A, seed 0"]
    assert [line.get_xdata()[0] for line in axes.lines] == [750, 1000]  # the alarm and the change


def test_without_labels_of_a_detector_there_is_no_figure_of_them_and_with_them_it_says_how_tasks_are_evaluated(
    tmp_path,
):
    write_run(tmp_path / "0")
    runs, _ = find_runs([tmp_path])
    assert (label_strips(sections(runs)[0]), label_notes(runs)) == (None, [])

    write_run(tmp_path / "1", seed=1, acted=[(1, 1, 0)] * 4)
    runs, _ = find_runs([tmp_path])
    with style():
        found = label_strips(sections(runs)[0])
    assert found is not None and "an oracle only in evaluation" in found.caption
    assert label_notes(runs)[0].startswith(
        "1 of 2 runs have labels of a detector: evaluation uses each task's most frequent label"
    )


@pytest.mark.parametrize(("number", "said"), [(5, True), (6, False)])
def test_the_caption_of_a_map_tells_of_intervals_up_to_the_last_that_has_them(monkeypatch, number, said):
    monkeypatch.setattr(heatmaps, "draw_matrices", lambda section, result: None)
    section, result = (
        SimpleNamespace(one=SimpleNamespace(about={}), labels=("task",) * number),
        SimpleNamespace(agent="ppo", n=3),
    )

    assert ("In brackets" in heatmaps.transfer_maps(section, result, {}).caption) == said


def test_units_are_drawn_over_the_life_on_fresh_images_where_they_were_measured(tmp_path):
    path = write_run(tmp_path / "0")
    assert unit_curves(sections(find_runs([tmp_path])[0])[0]) is None

    measured = {"kind": "units", "dead": 0.25, "dormant_0.1": 0.5, "rank_effective": 0.75}
    with (path / "run.jsonl").open("a") as file:
        for moment, images, frames in (("start", "fresh", 0), ("during", "task", 250), ("end", "fresh", 1000)):
            line = {**measured, "block": 1, "frames": frames, "moment": moment, "images": images}
            file.write(json.dumps(line) + "\n")
    with style():
        panels = unit_curves(sections(find_runs([tmp_path])[0])[0]).figure.axes

    drawn = [[tuple(zip(*line.get_data(), strict=True)) for line in axes.lines][1:] for axes in panels]
    assert drawn == [[((1000, 0.25),)], [((1000, 0.5),)], [((1000, 0.75),)]]
