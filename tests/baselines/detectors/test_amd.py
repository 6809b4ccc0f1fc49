"""AMD: its statistic by hand, p-values against SciPy, false alarms, and one transition that changes."""

from __future__ import annotations

import io
from itertools import chain

import pytest
import torch
from torch.testing import assert_close

import curricula
from baselines.detectors.amd import AMD, Counts, chi_squared_tail, clusters, statistic
from baselines.detectors.seen import Seen
from baselines.parts.catalogue import catalogue
from ctgraph_rl.learn.collect import collect, make_env

DEFAULTS = next(entry.settings for entry in catalogue("detector") if entry.name == "amd")
PAIR = curricula.dick2020_pair()


def amd(num_rows=1, num_actions=1, num_observations=3, **settings):
    """Return a detector that has been set up."""
    detector = AMD(**{**DEFAULTS, **settings})
    detector.setup(num_rows, 1, num_actions, num_observations)
    return detector


def independent(rows, probabilities, seed):
    """Return a batch of rows with 40 steps and one action, whose observations are independent."""
    random = torch.Generator().manual_seed(seed)
    ids = torch.multinomial(torch.tensor(probabilities), rows * 41, replacement=True, generator=random).view(rows, 41)
    flags, zeros = torch.zeros(rows, 40, dtype=torch.bool), torch.zeros(rows, 40)
    return Seen(ids[:, :-1] * 0, zeros, flags, flags, zeros, None, ids[:, :-1], ids[:, 1:])


def walk(task, num_frames, seed):
    """Yield batches of 16 rows of a task of the pair, acted by a policy that goes left but for a tenth of its steps."""
    random = torch.Generator().manual_seed(seed)

    def act(data):
        action = torch.where(data["observation"].argmax(-1) == 3, 1, 0)
        anything = torch.rand(16, generator=random) < 0.1
        return data.set("action", torch.where(anything, torch.randint(0, 3, (16,), generator=random), action))

    for batch in collect(make_env(PAIR, [PAIR.tasks[task]] * 16, seed), act, num_frames, 32):
        reward, done, starts = batch["next", "reward"][..., 0], batch["next", "done"][..., 0], batch["is_init"][..., 0]
        ids = (batch[key].argmax(-1) for key in ("observation", ("next", "observation")))
        yield Seen(batch["action"], reward, starts, done, reward, None, *ids)


def test_the_statistic_and_its_tail_are_those_of_pearson():
    chi2 = pytest.importorskip("scipy.stats").chi2
    observed = torch.tensor([[[6.0, 4.0, 0.0]], [[0.0, 3.0, 2.0]]]).double()
    expected = torch.tensor([[[5.0, 5.0, 0.0]], [[4.0, 1.0, 0.0]]]).double()

    found = statistic(observed, expected)

    assert found.tolist() == [0.2 + 0.2, 4.0 + 4.0 + 10 * 2.0**2]
    degrees = torch.tensor([3, 200])
    assert_close(chi_squared_tail(found, degrees), torch.from_numpy(chi2.sf(found, degrees)), rtol=1e-10, atol=0)


def test_clusters_are_those_of_dbscan():
    line = [0.0, 0.4, 0.8, 1.2, 1.65, 3.0, 3.1, 5.0, 5.1, 5.2]

    found = clusters(torch.tensor([line]).unsqueeze(-1), radius=0.5, min_neighbours=3)

    assert found.tolist() == [[1, 1, 1, 1, 1, -1, -1, 7, 7, 7]]


@pytest.mark.parametrize(("found", "left"), [(0, 10), (1, 0)])
def test_steps_in_no_window_yet_are_forgotten_at_a_doubt_and_by_a_new_label(found, left, monkeypatch):
    detector = amd(window=30)
    monkeypatch.setattr(detector, "_fit_label", lambda windows: found)

    assert detector.observe(independent(1, [0.5, 0.3, 0.2], 0)) is None
    assert (detector.is_doubted, len(detector.pending)) == (found == 1, left)

    detector.pending = torch.zeros(7, 3, dtype=torch.int64)
    detector.start_label(1, trial=False)
    assert (detector.is_doubted, len(detector.pending)) == (False, 0)


def test_counts_hold_what_occurred_alone():
    counts = Counts()
    counts.add(torch.tensor([7, 2, 7]))
    counts.add(torch.tensor([2**60, 7]))

    assert counts.of(torch.tensor([[0, 2], [7, 2**60]])).tolist() == [[0, 1], [3, 1]]
    assert counts.total == 5 and len(counts.keys) == 3


@pytest.mark.parametrize(("degrees", "least", "most"), [("corrected", 0.001, 0.999), ("published", 0.0, 0.001)])
def test_windows_of_a_model_that_is_right_are_refused_as_often_as_the_threshold_says(degrees, least, most):
    """400 windows at 0.1: with the corrected degrees within the quantiles 0.001 and 0.999, else below all of them."""
    binom = pytest.importorskip("scipy.stats").binom
    detector, probabilities = amd(400, degrees=degrees, order=1, num_untested=10**6), [0.5, 0.3, 0.2]
    for seed in range(10):
        detector.observe(independent(400, probabilities, seed))

    windows = detector.triples(independent(400, probabilities, seed=10)).view(400, 40, 3)

    refused = int((detector.p_values(0, windows) < 0.1).sum())
    assert binom.ppf(least, 400, 0.1) <= refused <= binom.ppf(most, 400, 0.1)


def test_one_transition_that_changes_is_seen_within_one_window():
    detector = amd(16, 3, 8, num_untested=1_000)
    assert {detector.observe(each) for each in walk(0, 6_144, seed=0)} == {None}
    windows = [detector.triples(next(walk(task, 512, seed=1)))[: 12 * 40].view(12, 40, 3) for task in (0, 1)]

    for degrees in ("published", "corrected"):
        detector.degrees = degrees
        of_before, of_after = (detector.p_values(0, each) for each in windows)

        assert of_before.min() > 0.01
        assert of_after.median() < 1e-12


def test_the_pair_that_alternates_has_the_labels_0_1_0_1_without_false_alarms():
    detector = amd(16, 3, 8, num_untested=1_000)
    found = []
    for number, batch in enumerate(chain(*(walk(task, 3_072, seed) for seed, task in enumerate((0, 1, 0, 1))))):
        verdict = detector.observe(batch)
        if verdict is not None:
            found.append((number, verdict))
            detector.start_label(verdict, trial=False)

    assert found == [(7, 1), (13, 0), (19, 1)]


def test_the_history_of_a_step_is_that_of_its_episode_whatever_the_batches():
    """Pairs (action, observation) are 1 + 3 action + observation, the newest is the last digit to the base 7."""
    detector = amd(1, 2, 3, order=3)
    ids, action = torch.tensor([[0, 1, 2, 1, 0, 2]]), torch.tensor([[1, 0, 1, 0, 1, 1]])
    starts = torch.tensor([[True, False, False, False, True, False]])
    steps = Seen(action, action.float(), starts, ~starts, action.float(), None, ids, ids.roll(-1, 1))

    parts = [
        detector.triples(Seen(*(each if each is None else each[:, part] for each in steps)))
        for part in (slice(2), slice(2, 6))
    ]

    digits = [[0, 0, 1], [0, 1, 5], [1, 5, 3], [5, 3, 5], [0, 0, 1], [0, 1, 6]]
    assert torch.cat(parts)[:, 0].tolist() == [49 * a + 7 * b + c for a, b, c in digits]
    assert torch.cat(parts)[:, 1:].tolist() == [
        list(each) for each in zip(action[0].tolist(), ids.roll(-1, 1)[0].tolist(), strict=True)
    ]


def test_the_smallest_p_value_of_a_batch_counts_times_its_windows(monkeypatch):
    detector, windows = amd(num_untested=0), torch.zeros(12, 40, 3)
    monkeypatch.setattr(detector, "p_values", lambda label, windows: torch.full((len(windows),), 0.002))

    assert [detector._fit_label(windows[:number]) for number in (4, 5, 12)] == [1, 0, 0]


def test_the_best_label_is_taken_at_once_only_as_published():
    p_values = [0.2, 0.9, 0.0]

    assert [amd(keeps_fitting=keeps)._label_for(p_values) for keeps in (True, False)] == [0, 1]
    assert amd()._label_for([0.001, 0.9]) == 1
    assert amd()._label_for([0.001, 0.009]) == 2
    assert amd(max_labels=1)._label_for([0.0]) == 0


def test_after_a_resume_nothing_differs():
    batches = list(chain(walk(0, 2_048, 0), walk(1, 1_024, 1)))
    whole, before, after = (amd(16, 3, 8, num_untested=500) for _ in range(3))

    def verdicts(detector, batches):
        found = []
        for batch in batches:
            found.append(detector.observe(batch))
            if found[-1] is not None:
                detector.start_label(found[-1], trial=False)
        return found

    expected = verdicts(whole, batches)
    verdicts(before, batches[:5])
    file = io.BytesIO()
    torch.save(before.state_dict(), file)
    file.seek(0)
    after.load_state_dict(torch.load(file, weights_only=True))

    assert 1 in expected
    assert verdicts(after, batches[5:]) == expected[5:]
    assert str(after.state_dict()) == str(whole.state_dict())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_observations": None}, "AMD needs one-hot observations, and these are images: take one-hot tasks"),
        ({"num_observations": 1000, "order": 9}, "order must be at most 5 with 1 actions and 1000 observations, got 9"),
        ({"degrees": "right"}, "degrees must be one of published, corrected, got 'right'"),
        ({"threshold": 2, "smoothing": 0}, r"smoothing must be a number > 0, got 0; threshold must be in \[0, 1\]"),
        ({"num_untested": -1}, "num_untested must be an integer >= 0, got -1"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(arguments, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        amd(**arguments)
