"""Exact evaluation against closed forms, against itself by another way, and against episodes."""

from __future__ import annotations

import math
from dataclasses import asdict, replace

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

import curricula
from ctgraph_rl import (
    Block,
    CTGraph,
    Curriculum,
    Evaluation,
    Gradient,
    GymTask,
    OneHot,
    Protocol,
    Recorder,
    evaluate,
    exact_success,
    exact_value,
    learn_curriculum,
    make_agent,
)
from ctgraph_rl.describe import describe
from ctgraph_rl.learn.collect import PREVIOUS_ACTION
from ctgraph_rl.learn.exact import ShownTask, exact_measures, measures_by_seed, shown_id
from ctgraph_rl.learn.logits_policy import LogitsPolicy
from ctgraph_rl.tasks.configurations import ct_co_b1, ct_fo_b1, ct_posr_b1, ct_su_b1
from ctgraph_rl.tasks.exactness import count_histories
from ctgraph_rl.tasks.values import open_loop_ceiling


def uniform(images):
    return torch.full((len(images), 3), 1 / 3, dtype=torch.float64)


def navigate(task):
    """A policy that waits at wait images and decides uniformly at others."""
    waits = task.images.bank(0)[task.observations.wait_ids[0] : task.observations.wait_ids[1] + 1]

    def probs(images):
        is_wait = (images.unsqueeze(1) == waits).flatten(2).all(2).any(1, keepdim=True)
        return torch.where(is_wait, torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.5, 0.5])).double()

    return probs


def few_images(task, num_waits=3):
    """A confounding task with a few wait images, whose histories are few."""
    first, _ = task.observations.wait_ids
    return replace(task, observations=replace(task.observations, wait_ids=(first, first + num_waits - 1)))


VARIANTS = {
    "surjective": ct_su_b1(),
    "full": ct_fo_b1(),
    "confounding": few_images(ct_co_b1()),
    "gradient": replace(ct_fo_b1(), reward_fn=Gradient(), goal_reward=2.0),
    "costs": replace(ct_fo_b1(), step_reward=-0.01, fail_reward=-0.5),
    "end step": replace(ct_su_b1(), extra_end_step=True, step_reward=-0.1),
    "swap": replace(ct_fo_b1(), swapped_branches=((2,), (1, 2))),
    "rotation": replace(ct_su_b1(), observations=replace(ct_su_b1().observations, read_rotation=2)),
    "waits": replace(ct_fo_b1(), graph=replace(ct_fo_b1().graph, depth=1, wait_prob=0.2), goal=(2,)),
}


class Spread(nn.Module):
    """Logits that differ from image to image."""

    def __init__(self, num_pixels=144):
        super().__init__()
        self.linear = nn.Linear(num_pixels, 3)
        nn.init.normal_(self.linear.weight, std=0.1, generator=torch.Generator().manual_seed(1))

    def forward(self, images):
        return self.linear(images.flatten(1) / 255)


class Dummy:
    """A policy without memory that passes for one with memory, so that histories are enumerated."""

    def __init__(self, module):
        self.module = module

    def action_probs(self, data):
        return self.module(data["observation"].double()).softmax(1), {}


@pytest.mark.parametrize("name", VARIANTS)
def test_histories_and_tables_of_a_policy_without_memory_give_the_same(name):
    task = VARIANTS[name]
    policy = Dummy(Spread().double())

    for gamma in (1.0, 0.9):
        table = exact_measures(policy, task, greedy=False, gamma=gamma)
        state = TensorDict({"nothing": torch.zeros(1, 1)}, [1])
        histories = exact_measures(policy, task, greedy=False, gamma=gamma, initial_state=lambda rows: state)  # noqa: B023
        assert asdict(histories) == pytest.approx(asdict(table), abs=2e-12)
    assert 0 < table.success_rate < table.end_rate < 1


@pytest.mark.parametrize("task", [ct_su_b1(), ct_fo_b1(), ct_co_b1(), ct_posr_b1()], ids=lambda task: "")
def test_reference_policies_have_their_closed_forms(task):
    assert exact_success(uniform, task) == pytest.approx(task.graph.reward_prob_random, abs=1e-12)
    assert exact_success(navigate(task), task) == pytest.approx(task.graph.reward_prob_navigation, abs=1e-12)
    assert exact_value(uniform, task) == pytest.approx(
        task.policy_value(uniform(range(task.images.num_images))), abs=1e-12
    )


def test_actions_are_deterministic_and_a_module_gives_logits():
    task = ct_fo_b1()
    first, last = task.observations.decision_ids
    bank = task.images.bank(0).flatten(1)
    actions = torch.zeros(len(bank), dtype=torch.int64)
    actions[first : last + 1] = 1
    act = lambda images: actions[(images.flatten(1).unsqueeze(1) == bank).all(2).int().argmax(1)]  # noqa: E731

    assert exact_success(act, replace(task, goal=(1, 1))) == 1
    assert exact_success(act, replace(task, goal=(1, 2))) == 0
    assert exact_value(act, replace(task, goal=(1, 1)), gamma=0.5) == 0.5**5
    assert 0 < exact_success(Spread(), task) < 1


class Count:
    """An agent that knows only how many actions it has taken: it plays a fixed sequence."""

    def __init__(self, *sequence):
        self.sequence = torch.tensor(sequence)

    def action_probs(self, data):
        step = data["step"].squeeze(1)
        actions = self.sequence[step.clamp(max=len(self.sequence) - 1)]
        return nn.functional.one_hot(actions, 3).double(), {("next", "step"): data["step"] + 1}


def start_of_count(num_rows):
    return TensorDict({"step": torch.zeros(num_rows, 1, dtype=torch.int64)}, [num_rows])


def test_a_fixed_sequence_reaches_the_open_loop_ceiling():
    task = replace(ct_su_b1(), graph=replace(ct_su_b1().graph, depth=1, wait_prob=0.5), goal=(2,))

    found = exact_measures(Count(0, 0, 2, 0), task, greedy=True, initial_state=start_of_count)

    assert found.success_rate == pytest.approx(open_loop_ceiling(task), abs=1e-11) == 0.5
    right = Count(0, 0, 1, 0, 1, 0)
    assert exact_measures(right, ct_su_b1(), greedy=True, initial_state=start_of_count).success_rate == 1


class Apart(Count):
    """Two agents of which the second decides otherwise."""

    def action_probs(self, data):
        probs, written = super().action_probs(data)
        return torch.where(data["seed"] == 1, probs[:, [0, 2, 1]], probs), written


def test_seeds_that_decide_otherwise_are_measured_at_once():
    def start(rows):
        return start_of_count(rows).set("seed", torch.arange(rows).unsqueeze(1))

    shown = ShownTask(ct_su_b1(goal=(2, 2)), ct_su_b1().observation_shape, None)
    found = measures_by_seed(Apart(0, 0, 1, 0, 1, 0), 2, shown, greedy=True, initial_state=start)

    assert [asdict(each) for each in found] == [
        {"return_mean": reward, "success_rate": reward, "end_rate": 1, "length_mean": 6} for reward in (0, 1)
    ]


class Repeat:
    """An agent that draws an action at home and then repeats its last one."""

    def action_probs(self, data):
        last = data[PREVIOUS_ACTION]
        probs = nn.functional.one_hot(last, 3).double()
        probs[data["is_init"].squeeze(1)] = torch.tensor([0.75, 0.25, 0.0], dtype=torch.float64)
        return probs, {}


def test_the_last_action_is_that_of_the_history():
    start = lambda rows: TensorDict({PREVIOUS_ACTION: torch.zeros(rows, dtype=torch.int64)}, [rows])  # noqa: E731

    found = exact_measures(Repeat(), ct_su_b1(), greedy=False, initial_state=start)

    assert asdict(found) == {"return_mean": 0, "success_rate": 0, "end_rate": 0, "length_mean": 0.75 * 3 + 0.25 * 2}


PARTLY = {"ppo": "fo_b1_4tasks", "dqn": "fo_b1_4tasks", "lstm_ppo": "su_b1_4tasks", "drqn": "su_b1_4tasks"}


def sharpened(name, curriculum):
    """An agent whose weights are larger than at initialisation: it acts differently from history to history."""
    torch.manual_seed(1)
    agent = make_agent(name, curriculum)
    with torch.no_grad():
        for parameter in agent.policy.parameters():
            parameter.mul_(1.5)
    if hasattr(agent, "exploration"):
        agent.exploration.eps.fill_(0.9)
    return agent


@pytest.mark.slow
@pytest.mark.parametrize("name", PARTLY)
def test_episodes_agree_within_four_standard_errors(name):
    curriculum = curricula.load(PARTLY[name])
    agent = sharpened(name, curriculum)
    task = curriculum.tasks[1]
    count = 400_000

    found = exact_measures(agent.policy, task, greedy=False, initial_state=agent.initial_state)
    ends = evaluate(agent.policy, [task], count, greedy=False, episodes_per_row=100, initial_state=agent.initial_state)

    for rate, least in (("success_rate", 3), ("end_rate", 2)):
        exact = getattr(found, rate)
        played = (ends["outcome"] >= least).double().mean().item()
        error = 4 * math.sqrt(exact * (1 - exact) / count)
        assert abs(played - exact) <= error
        assert abs(played - 1.5 * exact) > error  # a wrong formula fails
    length = ends["step_count"].double()
    assert abs(length.mean().item() - found.length_mean) <= 4 * length.std().item() / math.sqrt(count)


@pytest.mark.parametrize("name", PARTLY)
def test_greedy_episodes_are_equal(name):
    curriculum = curricula.load(PARTLY[name])
    agent = sharpened(name, curriculum)

    for task in curriculum.tasks:
        found = exact_measures(agent.policy, task, greedy=True, initial_state=agent.initial_state)
        (ends,) = evaluate(agent.policy, [task], 4, greedy=True, initial_state=agent.initial_state)
        assert ends["step_count"].tolist() == [[found.length_mean]] * 4
        assert (ends["outcome"] == 3).double().mean().item() == found.success_rate


def test_a_run_logs_exact_means_of_trained_held_out_and_masked_tasks():
    curriculum = curricula.load("su_b1_4tasks", num_frames=8192)
    held_out = replace(curriculum.tasks[0], goal=(1, 2), images=replace(curriculum.tasks[0].images, seed=9))
    evaluation = Evaluation(exact=True, held_out=(held_out,))
    curriculum = replace(curriculum, evaluation=evaluation, protocol=Protocol(task_id="one_hot"))

    log = learn_curriculum(curriculum, make_agent("ppo", curriculum, method="mask_ri"))

    lines = log.of_kind("evaluation")
    assert len(lines) == 5 * 5
    assert {(line["episodes"], line["exact"]) for line in lines} == {(None, True)}
    matrix = log.performance()
    assert matrix.shape[0] == 5


@pytest.mark.parametrize(
    ("name", "change", "reason"),
    [
        ("mohqa", {}, "^exact evaluation needs a policy with action_probs, which MOHQA has not: [^;]*$"),
        ("rl2", {}, "needs episodes that do not depend on earlier ones, as those of RL2 do"),
        ("lstm_ppo", {"graph": replace(ct_su_b1().graph, wait_prob=0.9)}, r"plays all histories, here 7.4e\+07, and"),
    ],
)
def test_what_has_no_exact_measures_is_refused_before_training(name, change, reason):
    task = replace(ct_su_b1(), **change)
    blocks = (Block((task, replace(task, goal=(2, 2))), 8192),)
    evaluation = Evaluation(exact=True, before=False)
    curriculum = Curriculum("own", 1, "none", blocks, evaluation=evaluation)
    agent = make_agent(name, replace(curriculum, evaluation=Evaluation(before=False)))

    with pytest.raises(ValueError, match=reason):
        make_agent(name, curriculum)
    with pytest.raises(ValueError, match=reason):
        learn_curriculum(curriculum, agent)


NOISE = replace(ct_su_b1(), observations=replace(ct_su_b1().observations, read_noise=2))
CHANGES = replace(ct_su_b1(), goal_change=(2, 2))
LAKE = GymTask("FrozenLake-v1")


@pytest.mark.parametrize(
    ("task", "reason"),
    [
        (NOISE, "needs images without noise, got read_noise=2"),
        (CHANGES, r"needs a goal that stays, got goal_change=\(2, 2\)"),
        (LAKE, "needs CT-graphs, got GymTask"),
    ],
)
def test_a_curriculum_of_tasks_without_exact_measures_is_refused_wherever_it_is_made(task, reason):
    played = Curriculum("own", 1, "none", (Block(task, 8192),), Evaluation(episodes_per_row=2, num_episodes=4))

    with pytest.raises(ValueError, match=f"^exact evaluation {reason}: set evaluation.exact=false, which plays"):
        replace(played, evaluation=Evaluation(exact=True))


def test_held_out_tasks_without_exact_measures_are_refused():
    with pytest.raises(ValueError, match="got read_noise=2"):
        replace(curricula.load("su_b1_4tasks"), evaluation=Evaluation(exact=True, held_out=(NOISE,)))


def test_a_recorder_refuses_before_training_what_has_no_exact_measures():
    late = replace(curricula.load("su_b1_4tasks"), evaluation=Evaluation(exact=True, before=False))

    with pytest.raises(ValueError, match=r"^evaluation.exact=true needs evaluation.before=true: it shows before train"):
        Recorder(late)
    with Recorder(replace(late, evaluation=Evaluation(exact=True, greedy=False))) as recorder:
        with pytest.raises(ValueError, match=r"action_probs, which navigate has not: set evaluation.exact=false"):
            recorder.evaluate(navigate, 0)
        assert recorder.evaluate(nn.Sequential(nn.Flatten(), nn.Linear(144, 3)), 0)["goal1.1"] > 0


def test_a_description_says_that_agents_with_memory_are_refused_where_they_are():
    exact = replace(curricula.load("su_b1_4tasks"), evaluation=Evaluation(exact=True))
    waits = tuple(replace(task, graph=replace(task.graph, wait_prob=0.9)) for task in exact.tasks)

    said = [
        str(dict(describe(each)[0].rows)["evaluation"]) for each in (exact, replace(exact, blocks=(Block(waits, 64),)))
    ]

    assert ["Agents with memory are refused" in each for each in said] == [False, True]


def test_a_goal_that_changes_and_what_is_no_policy_have_no_exact_measures():
    task = replace(ct_su_b1(), goal_change=(2, 2))

    with pytest.raises(ValueError, match=r"a goal that stays, got goal_change=\(2, 2\): set evaluation.exact=false"):
        exact_success(uniform, task)
    with pytest.raises(ValueError, match="policy must be a function of images or a module, got None"):
        exact_success(None, ct_su_b1())


class Elsewhere(nn.Module):
    """Has its weights on another device, and a state."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(1, device="meta"))

    def action_probs(self, data):
        assert {value.device.type for value in data.values()} == {"meta"}
        probs = uniform(data["observation"])
        return probs, {("next", "state"): torch.zeros(len(probs), 1)} if "state" in data else {}


@pytest.mark.parametrize("state", [None, lambda count: {"state": torch.zeros(count, 1)}])
def test_images_and_states_are_where_the_weights_are(state):
    found = exact_measures(Elsewhere(), ct_su_b1(), greedy=False, initial_state=state)

    assert found.success_rate == pytest.approx(1 / 243)


def test_adaptation_is_not_exact():
    with pytest.raises(ValueError, match="exact must be false with adapt_episodes=3"):
        Evaluation(exact=True, adapt_episodes=3)


def test_the_id_that_is_shown_is_one_hot_zeros_for_a_held_out_task_and_none_where_ids_are_hidden():
    hidden = curricula.load("su_b1_4tasks")
    shown = replace(hidden, protocol=Protocol(task_id="one_hot"))
    held_out = replace(hidden.tasks[0], images=replace(hidden.tasks[0].images, seed=9))

    assert shown_id(hidden, hidden.tasks[1]) is None
    assert shown_id(shown, hidden.tasks[1]).tolist() == [0, 1, 0, 0]
    assert shown_id(shown, held_out).tolist() == [0, 0, 0, 0]


def test_vectors_are_padded_to_those_of_longer_tasks_as_episodes_show_them():
    short = replace(ct_su_b1(), images=OneHot(ct_su_b1().images.num_images))
    long = replace(ct_su_b1(), images=OneHot(9))
    policy = LogitsPolicy(Spread(9), 3)

    found = exact_measures(policy, short, greedy=True, shape=long.observation_shape)
    ends, _ = evaluate(policy, [short, long], 2)

    assert ends["step_count"].tolist() == [[found.length_mean]] * 2


def test_the_count_of_histories_is_that_of_the_images_drawn():
    assert count_histories(ct_su_b1(), False) == 4
    assert count_histories(ct_su_b1(), True) == 3 * 4
    assert count_histories(few_images(ct_co_b1(), 3), False) == 3**3 * 4
    assert count_histories(replace(ct_su_b1(), graph=CTGraph(2, 1, 0.9), goal=(1,)), False) == 2 * 264**2


@pytest.mark.parametrize("wait_prob", [0.7, 0.9])
def test_histories_beyond_all_floats_are_endless_and_told_so(wait_prob):
    task = curricula.load("co_hard").tasks[0]
    task = replace(task, graph=replace(task.graph, wait_prob=wait_prob))
    blocks = (Block(task, 8192),)
    curriculum = Curriculum("own", 1, "none", blocks, evaluation=Evaluation(exact=True))

    assert count_histories(task, False) == math.inf
    assert "Agents with memory are refused" in str(describe(curriculum))
    with pytest.raises(ValueError, match="here more than 1e308, and at most"):
        make_agent("lstm_ppo", curriculum)


@pytest.mark.parametrize("name", ["dqn", "qrdqn_lstm"])
def test_exploration_has_its_share_of_every_action(small_agent, name):
    task = ct_su_b1()
    agent = small_agent(name, [task])
    agent.exploration.eps.fill_(0.3)
    data = {"observation": torch.zeros(2, *task.observation_shape, dtype=torch.uint8), "is_init": torch.ones(2, 1) > 0}
    data |= dict(agent.initial_state(2).items())

    with set_exploration_type(ExplorationType.RANDOM):
        probs, _ = agent.policy.action_probs(data)

    assert torch.allclose(probs.sort(dim=1).values, probs.new_tensor([0.1, 0.1, 0.8]))
