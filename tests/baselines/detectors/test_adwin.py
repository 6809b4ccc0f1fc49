"""ADWIN on the return: its bound by hand, false alarms, falls and rises, trials, a run, and River's absence."""

from __future__ import annotations

import io
import math
import sys
from dataclasses import replace

import pytest
import torch
from helpers.scripted import ONE, of
from helpers.small_agents import MINIBATCHES, TINY, made

from baselines.detectors.adwin import ADWIN, Returns, bound
from baselines.detectors.seen import SUSPICION, Seen
from baselines.parts.catalogue import catalogue
from ctgraph_rl import Block, RunLog, learn_curriculum
from ctgraph_rl.runs.train import new_agent

pytest.importorskip("river")

DEFAULTS = next(entry.settings for entry in catalogue("detector") if entry.name == "adwin")


def episodes(number, success, seed=0):
    """Yield batches of 2 rows x 16 steps in which each episode has 4 steps, and a return of 1 with a probability."""
    random = torch.Generator().manual_seed(seed)
    done = torch.zeros(2, 16, dtype=torch.bool)
    done[:, 3::4] = True
    for _ in range(number // 8):
        returns = torch.where(done, (torch.rand(2, 16, generator=random) < success).float(), 0.5)
        yield Seen(torch.zeros(2, 16, dtype=torch.int64), returns, ~done, done, returns)


def verdicts(detector, batches):
    """Return the verdicts on batches."""
    return [detector.observe(batch) for batch in batches]


def test_the_bound_is_that_of_adwin():
    first, second = Returns(100, 0.9, 0.09), Returns(50, 0.6, 0.24)
    log, variance = math.log(2 * math.log(150) / 0.002), (100 * 0.09 + 50 * 0.24 + 100 * 0.1**2 + 50 * 0.2**2) / 150

    assert bound(first, second, 0.002) == pytest.approx(math.sqrt(2 * 0.03 * variance * log) + 2 / 3 * 0.03 * log)


def test_a_fall_is_suspected_within_a_hundred_episodes_and_a_rise_is_not():
    detector = ADWIN(**DEFAULTS)

    assert set(verdicts(detector, episodes(320, 0.2))) == {None}
    assert set(verdicts(detector, episodes(400, 0.9, seed=1))) == {None}
    assert SUSPICION in verdicts(detector, episodes(104, 0.2, seed=2))
    assert detector.kept[0].mean == pytest.approx(0.9, abs=0.1) and detector.kept[0].number > 250


def test_a_return_that_does_not_change_is_suspected_in_few_of_40_streams():
    """ADWIN promises at most delta at each look, here 0.002 x 31 looks: the quantile 0.999 of a binomial is 8."""
    binom = pytest.importorskip("scipy.stats").binom

    found = sum(SUSPICION in verdicts(ADWIN(**DEFAULTS), episodes(1000, 0.5, seed)) for seed in range(40))

    assert found <= binom.ppf(0.999, 40, 0.002 * 31)


@pytest.mark.parametrize(("success", "accepted"), [(0.9, True), (0.3, False)])
def test_a_label_on_trial_is_accepted_where_its_returns_are_back(success, accepted):
    detector = ADWIN(**DEFAULTS)
    verdicts(detector, episodes(800, 0.9))
    assert SUSPICION in verdicts(detector, episodes(160, 0.1))

    detector.start_label(0, trial=True)
    found = verdicts(detector, episodes(400, success, seed=3))

    assert found[:6] == [None] * 6
    assert (0 in found) is accepted


def test_an_episode_that_another_label_began_counts_for_none():
    detector = ADWIN(**{**DEFAULTS, "num_trial_episodes": 1})
    detector.kept[0] = Returns(100, 1.0, 0.0)
    begins, ends, returns = (torch.zeros(2, 4) for _ in range(3))
    begins[0, 2] = ends[0, 1] = ends[0, 3] = ends[1, 3] = returns[0, 3] = 1
    batch = Seen(torch.zeros(2, 4, dtype=torch.int64), returns, begins.bool(), ends.bool(), returns)

    detector.start_label(0, trial=True)

    assert (detector.observe(batch), detector.returns) == (0, [1.0])
    assert detector.is_whole.tolist() == [True, False]  # the second row's first episode ends with the batch
    detector.observe(batch._replace(is_init=torch.zeros(2, 4, dtype=torch.bool)))
    assert detector.returns == [1.0, 0.0, 1.0]


def test_a_run_whose_failures_begin_to_cost_is_rolled_back_and_opens_a_label(compose):
    settings = ("clock=1", "grace_period=4", "min_window_length=2", "delta=0.5", "patience=32", "snapshot_every=32")
    detector = made(compose, "detector", "adwin", *(f"detector.{each}" for each in settings))()
    whole, log = detector.labelling(made(compose, "method", "mask_ri")()), RunLog()
    curriculum = of(Block(ONE, 128), Block(replace(ONE, fail_reward=-1.0), 128), boundaries="hidden")
    make_agent = made(compose, "agent", "ppo", *TINY, *MINIBATCHES)
    agent = new_agent(curriculum, lambda *specs: whole.attach(make_agent(*specs), whole.prepare(curriculum)), 0)

    torch.manual_seed(1)
    learn_curriculum(curriculum, agent, 7, log)

    assert log.training("acted_label").tolist() == [1, 1, 1, 1, 1, 1, 2, 2]
    assert log.training("learned").tolist() == [1, 1, 1, 1, 0, 0, 1, 1]
    assert log.training("alarm").tolist() == [0, 0, 0, 0, 1, 0, 0, 0]
    assert log.training("rolled_back").tolist() == [0, 0, 0, 0, 32, 0, 0, 0]
    assert (agent.label, detector.label) == (1, 1) and detector.kept[0].mean > -0.1


def test_after_a_resume_nothing_differs():
    batches = [*episodes(800, 0.9), *episodes(160, 0.1, seed=1)]
    whole, before, after = (ADWIN(**DEFAULTS) for _ in range(3))

    expected = verdicts(whole, batches)
    verdicts(before, batches[:90])
    file = io.BytesIO()
    torch.save(before.state_dict(), file)
    file.seek(0)
    after.load_state_dict(torch.load(file, weights_only=True))

    assert SUSPICION in expected
    assert verdicts(after, batches[90:]) == expected[90:]
    assert str(after.state_dict()) == str(whole.state_dict())


def test_without_river_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "river.drift", None)

    with pytest.raises(
        ModuleNotFoundError, match=r"^detector=adwin needs river: pip install 'ctgraph_rl\[detectors\]'$"
    ):
        ADWIN(**DEFAULTS)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"delta": 0.0}, r"delta must be in \(0, 1\), got 0.0"),
        ({"delta": "x"}, r"delta must be in \(0, 1\), got 'x'"),
        ({"clock": 0, "num_trial_episodes": 0}, "clock must be an integer >= 1, got 0; num_trial_episodes must be"),
        ({"grace_period": -1}, r"grace_period must be an integer in \[0, 2\*\*63\), got -1"),
    ],
)
def test_a_setting_out_of_range_is_refused_by_name(changed, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        ADWIN(**{**DEFAULTS, **changed})
