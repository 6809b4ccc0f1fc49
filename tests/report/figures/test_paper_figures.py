"""Figures for a paper: widths, colours, fonts within, several experiments, profiles, probabilities of improvement."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from helpers.made_runs import all_runs, write_run

from ctgraph_rl.draw.style import picture
from ctgraph_rl.report import page
from ctgraph_rl.report import page as command
from ctgraph_rl.report.figures.aggregates import (
    improvements,
    performance_profile,
    probability_of_improvement,
    profiles,
)
from ctgraph_rl.report.figures.gallery import Gallery
from ctgraph_rl.report.figures.learning_curves import experiments, mean_curves
from ctgraph_rl.report.sections import sections
from ctgraph_rl.report.style import style

pytest.importorskip("matplotlib")
pytest.importorskip("scipy")


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """The sections of two curricula; on the first, PPO ends at returns 0.5 and 1, DQN at 0 and 1, three seeds each."""
    folder = tmp_path_factory.mktemp("paper")
    for seed in range(3):
        write_run(folder / f"ppo{seed}", seed=seed)
        write_run(folder / f"dqn{seed}", seed=seed, agent="DQN", performance=((0, 0), (1, 0), (0, 1)))
    write_run(folder / "other", curriculum=("other", "g"), agent="DQN")
    return sections(all_runs([folder]))


def test_a_profile_is_the_share_of_runs_and_tasks_above_each_threshold():
    of_tasks = {"a": np.array([0.0, 0.5, 1.0]), "b": np.array([0.25, 0.25, 0.75])}

    profile = performance_profile(of_tasks, np.array([-1.0, 0.0, 0.25, 0.5, 1.0]))

    assert profile.value.tolist() == [1.0, 5 / 6, 3 / 6, 2 / 6, 0.0]
    assert profile.low[0] == profile.high[0] == 1.0
    assert (profile.low <= profile.value).all() and (profile.value <= profile.high).all()
    assert (profile.low[1], profile.high[1]) == (0.5, 1.0)  # task b is above 0 in every sample, task a in 0 to 3 of 3


def test_the_probability_of_improvement_is_the_mean_of_mann_whitney_over_tasks():
    first = {"a": np.array([1.0, 2.0]), "b": np.array([1.0, 1.0])}
    second = {"a": np.array([0.0, 1.0]), "b": np.array([1.0, 2.0])}

    found = probability_of_improvement(first, second)

    assert found.value == ((3 + 0.5) / 4 + (0.5 + 0 + 0.5 + 0) / 4) / 2
    assert 0 <= found.low < found.value < found.high <= 1
    same = probability_of_improvement({"a": np.ones(3)}, {"a": np.ones(3)})
    assert (same.low, same.value, same.high) == (0.5, 0.5, 0.5)


def test_agents_of_enough_seeds_have_both_figures(found):
    with style("column"):
        profile, improvement = profiles(found[0]).figure, improvements(found[0]).figure

    assert [len(line.get_xdata()) for line in profile.axes[0].lines] == [101, 101]
    assert [text.get_text() for text in improvement.axes[0].get_yticklabels()] == ["DQN\nover PPO"]
    (estimate,) = [line for line in improvement.axes[0].lines if line.get_linestyle() == "-"]
    assert estimate.get_xdata()[0] == 0.25  # never on the first task, equal on the second
    assert (profiles(found[1]), improvements(found[1])) == (None, None)


def test_several_experiments_are_panels_of_one_figure_with_one_colour_an_agent(found):
    with style(colours={"DQN": "#123456"}):
        figure = experiments(found).figure

    assert [axes.get_title() for axes in figure.axes] == ["two", "other"]
    colours = [{line.get_color() for line in axes.lines if len(line.get_xdata()) > 2} for axes in figure.axes]
    assert colours == [{"#123456", "#D55E00"}, {"#123456"}]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["DQN", "PPO"]
    assert experiments(found[:1]) is None


def test_a_figure_of_a_column_is_narrow_and_has_its_fonts_within(found):
    with style("column"):
        figure = mean_curves(found[0]).figure
        pdf = picture(figure, "pdf")

    assert figure.get_figwidth() == 3.5
    assert b"/FontFile2" in pdf and b"/Type3" not in pdf
    with style():
        assert mean_curves(found[0]).figure.get_figwidth() == 7.2


def test_the_report_has_the_width_and_the_colours_that_are_asked_for(tmp_path, monkeypatch):
    pytest.importorskip("jinja2")
    write_run(tmp_path / "run")
    galleries = []
    monkeypatch.setattr(Gallery, "write", lambda self, names, figures: galleries.append(self) or [])
    options = ["--width", "column", "--colour", "PPO=tab:red", "--out", str(tmp_path / "report")]
    monkeypatch.setattr(sys, "argv", ["report", str(tmp_path / "run"), *options])

    command.main()

    assert {(gallery.width, *gallery.colours.items()) for gallery in galleries} == {("column", ("PPO", "tab:red"))}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"width": "page"}, "width must be one of text, column, got 'page'"),
        ({"colours": ["PO=red"]}, "--colour: there is no agent 'PO'"),
        ({"colours": ["PPO=rod"]}, "the colour of PPO must be one that matplotlib knows"),
        ({"colours": ["red"]}, "--colour must be NAME=COLOUR, got 'red'"),
    ],
)
def test_a_look_that_there_is_not_is_refused_before_any_work(tmp_path, options, message):
    write_run(tmp_path / "run")

    with pytest.raises(ValueError, match=message):
        page.write_report([tmp_path / "run"], tmp_path / "report", **options)

    assert not (tmp_path / "report").exists()
