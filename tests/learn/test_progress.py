"""The progress bar: one line on a terminal, lines now and then elsewhere."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from ctgraph_rl.learn import progress
from ctgraph_rl.learn.progress import ProgressBar, StepCounter


def written(terminal: bool) -> Console:
    return Console(file=io.StringIO(), force_terminal=terminal, width=200)


def test_a_line_shows_block_frames_rate_return_and_time_left():
    bar = ProgressBar(num_blocks=4, num_frames=10_000, console=written(False))

    line = bar.describe(block=2, frames=2_500, episode_return=0.756, seconds=10.0)

    assert line == "block 2/4  2.5k/10k frames  250/s  return 0.76  0:00:30 left"


def test_a_return_without_episodes_is_a_dash():
    bar = ProgressBar(1, 1_000, written(False))

    line = bar.describe(1, 500, float("nan"), 0.5)

    assert line == "block 1/1  500/1k frames  1k/s  return -  0:00:00 left"


@pytest.mark.parametrize(
    ("frames", "shown"), [(960, "960"), (20_480, "20.48k"), (819_200, "819.2k"), (1_638_400, "1.638M")]
)
def test_frames_are_shown_with_four_digits(frames, shown):
    bar = ProgressBar(1, frames, written(False))

    line = bar.describe(1, frames, 1.0, seconds=frames / 50)

    assert line == f"block 1/1  {shown}/{shown} frames  50/s  return 1.00  0:00:00 left"


def test_elsewhere_than_on_a_terminal_a_line_comes_every_ten_seconds_and_at_the_end(monkeypatch):
    now = iter([0.0, 4.0, 10.0, 12.0, 19.0, 20.0, 21.0])
    monkeypatch.setattr(progress.time, "perf_counter", lambda: next(now))
    console = written(False)

    with ProgressBar(1, 600, console) as bar:
        for frames in range(100, 700, 100):
            bar.update(1, frames, 0.5)

    lines = console.file.getvalue().splitlines()
    assert [line.split()[2] for line in lines] == ["200/600", "500/600", "600/600"]
    assert lines[0] == "block 1/1  200/600 frames  20/s  return 0.50  0:00:20 left"


@pytest.mark.parametrize("frames", [300, 600])
def test_on_a_terminal_the_last_state_stays_visible(frames):
    console = written(True)

    with ProgressBar(2, 600, console) as bar:
        bar.update(1, frames, 1.0)

    assert f"{frames}/600 frames" in console.file.getvalue()
    assert "return 1.00" in console.file.getvalue()


def test_an_error_passes_through_the_bar():
    with pytest.raises(KeyError), ProgressBar(1, 100, written(True)):
        raise KeyError


@pytest.mark.parametrize("terminal", [False, True])
def test_a_run_that_goes_on_says_so_at_once(terminal):
    console = written(terminal)

    with ProgressBar(2, 6_000, console, done=2_500) as bar:
        pass

    said = console.file.getvalue()
    assert "resumed after 2.5k frames" in said
    assert bar._bar.tasks[0].completed == 2_500
    assert "evaluating before training" not in said


def test_steps_have_a_line_with_rate_and_time_left_every_ten_seconds(monkeypatch):
    now = iter([0.0, 1.0, 4.0, 5.0, 14.0, 16.0])
    monkeypatch.setattr(progress.time, "perf_counter", lambda: next(now))
    console = written(False)

    with StepCounter(console) as count:
        for done in (1, 2, 3, 4):
            count("runs read", done, 8)
        count("agents", 1, 3)

    assert console.file.getvalue().splitlines() == ["4/8 runs read  0.286/s  0:00:14 left"]


def test_the_steps_of_a_quick_command_are_not_shown():
    console = written(True)

    with StepCounter(console) as count:
        count("runs read", 1, 1)

    assert console.file.getvalue() == ""
