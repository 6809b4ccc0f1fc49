"""SWOKS: distances of moved samples, p-values against SciPy, false alarms, delays, labels of alternating streams."""

from __future__ import annotations

import io
from itertools import chain

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from baselines.detectors.seen import SUSPICION, Seen
from baselines.detectors.swoks import SWOKS, points_of
from baselines.detectors.two_sample import ks_greater
from baselines.parts.catalogue import catalogue
from baselines.parts.embedding import sliced_distances, unit_directions

PUBLISHED = next(entry.settings for entry in catalogue("detector") if entry.name == "swoks")
SMALL = {"window": 20, "num_windows": 40, "num_directions": 5, "num_tested": 8, "num_left_out": 10, "num_kept": 40}


def seen(features, reward=None):
    """Return a batch of one row, with features [steps, F], in which the action is always 0."""
    steps, never = len(features), torch.zeros(1, len(features), dtype=torch.bool)
    reward = torch.zeros(1, steps) if reward is None else reward
    return Seen(torch.zeros(1, steps, dtype=torch.int64), reward, never, never, reward, features.unsqueeze(0))


def stream(length, shift=0.0, seed=0, width=16):
    """Return independent features around a mean, float32 [length, width]."""
    return shift + 0.3 * torch.randn(length, width, generator=torch.Generator().manual_seed(seed))


def labels_given(detector, batches, patience):
    """Return the labels with which learning went on after each suspicion: known ones are tried in their order."""
    given, known, queue, tried = [0], 1, [], 0
    for batch in batches:
        verdict = detector.observe(batch)
        tried += batch.action.numel()
        if verdict is SUSPICION:
            queue, tried = list(range(known)), 0
            detector.start_label(queue.pop(0), trial=True)
        elif verdict is not None:
            detector.start_label(verdict, trial=False)
            given.append(verdict)
        elif detector.is_trial and tried >= patience:
            label, tried = (queue.pop(0) if queue else known), 0
            detector.start_label(label, trial=label < known)
            given += [label] * (label == known)
            known += label == known
    return given


@pytest.mark.parametrize("seed", range(3))
def test_a_sample_that_is_moved_is_as_far_as_its_move_along_the_directions(seed):
    random = torch.Generator().manual_seed(seed)
    points, moves = (torch.randn(n, 7, generator=random, dtype=torch.float64) for n in (40, 3))
    directions = unit_directions(50, 7).double()

    moved = points[torch.randperm(40, generator=random)] + moves.unsqueeze(1)

    expected = (moves @ directions.T).square().mean(dim=1).sqrt()
    assert_close(sliced_distances(moved, points, directions), expected, rtol=1e-12, atol=0)


def test_a_step_is_a_point_of_action_weighted_reward_and_features_row_after_row():
    features, flags = torch.arange(24.0).view(2, 3, 4), torch.zeros(2, 3, dtype=torch.bool)
    action, reward = torch.tensor([[0, 1, 2], [2, 1, 0]]), torch.tensor([[0.0, 0.0, 1.0], [0.0, -0.5, 0.0]])

    points = points_of(Seen(action, reward, flags, flags, reward, features))

    assert points[:, 0].tolist() == [0, 1, 2, 2, 1, 0]
    assert points[:, 1].tolist() == [0, 0, 2, 0, -1, 0]
    assert points[:, 2:].tolist() == features.flatten(0, 1).tolist()


@pytest.mark.parametrize(("m", "n"), [(1, 1), (3, 5), (163, 42), (42, 42), (90, 60)])
@pytest.mark.parametrize("shift", [-1.0, 0.0, 0.3, 1.0, 3.0])
@pytest.mark.parametrize("ties", [False, True])
def test_p_values_are_those_of_scipy(m, n, shift, ties):
    ks_2samp = pytest.importorskip("scipy.stats").ks_2samp
    random = np.random.default_rng(m + n)
    first, second = random.normal(size=m).round(1 if ties else 9), (shift + random.normal(size=n)).round(1)

    expected = ks_2samp(first, second, alternative="greater", method="exact").pvalue

    assert ks_greater(first, second) == pytest.approx(expected, rel=1e-11)


def test_independent_streams_are_suspected_as_often_as_alpha_says():
    """60 streams, each with one test at alpha=0.2: the number of suspicions is binomial, with a chance of at most 0.2.

    A p-value of two samples has 0.154 = P(p < 0.2) as m=32 and n=8 have few different ones. The bounds are the
    quantiles 0.0005 and 0.9995 of the two.
    """
    binom = pytest.importorskip("scipy.stats").binom
    settings = {**PUBLISHED, **SMALL, "alpha": 0.2, "adjustment": 1.0, "stable_phase": 43 * 20, "num_fresh": 0}

    found = 0
    for seed in range(60):
        detector = SWOKS(**settings)
        assert detector.observe(seen(stream(43 * 20, seed=seed, width=2))) is None
        found += detector.observe(seen(stream(20, seed=1000 + seed, width=2))) is SUSPICION

    assert binom.ppf(0.0005, 60, 0.15) <= found <= binom.ppf(0.9995, 60, 0.2)


def first_suspicion(changes_at, length):
    """Return after how many steps a stream is suspected that repeats 240 points, and is moved after some; or None."""
    detector = SWOKS(**PUBLISHED)
    points = stream(240).repeat(-(-length // 240), 1)[:length]
    points[changes_at:] += 1.0
    batches = enumerate(points.split(240), 1)
    return next((240 * number for number, batch in batches if detector.observe(seen(batch)) is SUSPICION), None)


@pytest.mark.parametrize("changes_at", [50_400, 50_500, 51_599])
def test_a_change_is_suspected_after_14_windows_that_are_further_away(changes_at):
    """With 163 to 170 earlier distances p is 0.0012 after 13 windows, and 0.0004 after 14."""
    assert first_suspicion(changes_at, changes_at + 4_000) == changes_at // 240 * 240 + 14 * 240


def test_distances_that_grow_by_less_than_the_adjustment_are_as_before():
    detector = SWOKS(**PUBLISHED)

    assert detector._p_value([1.0] * 200, [1.09] * 42) == 1
    assert detector._p_value([1.0] * 200, [1.11] * 42) < 1e-30


def test_after_a_longer_stay_more_earlier_distances_save_a_window():
    assert first_suspicion(61_440, 65_000) == 61_440 + 13 * 240


def test_a_change_in_the_stable_phase_is_suspected_right_after_it_and_never_if_it_was_early():
    assert first_suspicion(45_120, 51_000) == 50_160
    assert first_suspicion(12_000, 62_000) is None


def test_an_independent_stream_is_not_suspected():
    detector = SWOKS(**PUBLISHED)

    assert {detector.observe(seen(batch)) for batch in stream(72_000).split(480)} == {None}


def test_a_label_that_is_left_keeps_its_oldest_window_and_all_but_the_newest_distances():
    detector = SWOKS(**{**PUBLISHED, **SMALL, "stable_phase": 1_000})
    points = torch.cat([stream(1_400), stream(400, shift=1.0)])

    windows = enumerate(points.split(20), 1)
    number = next(number for number, window in windows if detector.observe(seen(window)) is SUSPICION)

    oldest = points[20 * (number - 41) :][:20]
    assert number > 70 and torch.equal(detector.references[0], points_of(seen(oldest)))
    assert len(detector.distances[0]) == 40 and detector.earlier[0] == detector.distances[0][:30]


@pytest.mark.parametrize(
    ("settings", "window"), [({**SMALL, "stable_phase": 1_000}, 20), pytest.param({}, 240, marks=pytest.mark.slow)]
)
def test_alternating_streams_have_the_labels_0_1_0_1(settings, window):
    detector = SWOKS(**{**PUBLISHED, **settings})
    patience, stay = 50 * window, max(250, -(-detector.stable_phase // window)) * window
    stays = [stream(stay, shift=2.0 * (k % 2), seed=k) for k in range(4)]

    given = labels_given(
        detector, (seen(batch) for batch in chain(*(each.split(2 * window) for each in stays))), patience
    )

    assert given == [0, 1, 0, 1]


@pytest.mark.parametrize(("num_fresh", "windows"), [(0, 0), (8, 8), (12, 12)])
def test_a_label_on_trial_is_accepted_once_the_newest_distances_fit_and_enough_are_its_own(num_fresh, windows):
    detector = SWOKS(**{**PUBLISHED, **SMALL, "stable_phase": 600, "num_fresh": num_fresh})
    assert detector.observe(seen(stream(800))) is None
    assert detector.observe(seen(stream(400, shift=1.0))) is SUSPICION
    detector.start_label(1, trial=False)
    assert detector.observe(seen(stream(800))) is None

    detector.start_label(0, trial=True)
    batches = stream(600, seed=1).split(20)

    first = next(number for number, batch in enumerate(batches, 1) if detector.observe(seen(batch)) == 0)
    assert first == max(windows, 1)


@pytest.mark.parametrize("steps", [170, 820, 1210])
def test_after_a_resume_nothing_differs(steps):
    settings = {**PUBLISHED, **SMALL, "stable_phase": 600, "num_fresh": 0}
    points = torch.cat([stream(800), stream(800, shift=1.0)])
    whole, before = SWOKS(**settings), SWOKS(**settings)

    def verdicts(detector, points):
        found = []
        for batch in points.split(10):
            found.append(detector.observe(seen(batch)))
            if found[-1] is SUSPICION:
                detector.start_label(0, trial=True)
        return found

    expected = verdicts(whole, points)
    verdicts(before, points[:steps])
    file = io.BytesIO()
    torch.save(before.state_dict(), file)
    file.seek(0)
    after = SWOKS(**settings)
    after.load_state_dict(torch.load(file, weights_only=True))

    assert SUSPICION in expected
    assert verdicts(after, points[steps:]) == expected[steps // 10 :]
    assert str(after.state_dict()) == str(whole.state_dict())


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"window": 0}, "window must be an integer >= 1, got 0"),
        ({"num_left_out": 41}, "num_left_out must be at least num_tested=42, got 41"),
        ({"num_kept": 50}, "num_kept must be above num_left_out=50 and at most 1000, got 50"),
        ({"num_kept": 1001}, "num_kept must be above num_left_out=50 and at most 1000, got 1001"),
        ({"alpha": 1.5, "accept": -1}, r"alpha must be in \[0, 1\], got 1.5; accept must be in \[0, 1\], got -1"),
        ({"adjustment": 0}, "adjustment must be a number > 0, got 0"),
        ({"stable_phase": -1}, "stable_phase must be an integer >= 0, got -1"),
        ({"num_fresh": 126}, r"num_fresh must be an integer in 0..125, the windows in patience=30000 .*, got 126"),
    ],
)
def test_a_setting_out_of_range_is_refused_by_name(changed, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        SWOKS(**{**PUBLISHED, **changed})
