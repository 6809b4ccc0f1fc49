"""Evaluation: equally many episodes on every task, at the moments of a curriculum."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ctgraph_rl.agent import Agent
from ctgraph_rl.checks import NamedValues, as_tuple, require, takes_numbers
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.core.dynamics import OUTCOME_FAIL, OUTCOME_GOAL
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.learn.collect import ENDS, InitialState, Policy, Step, act, acted, agent_specs, make_env, make_start
from ctgraph_rl.learn.exact import ShownTask, measures_by_seed, shown_id
from ctgraph_rl.learn.labels import task_labels
from ctgraph_rl.learn.logits_policy import as_policy
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.metrics.adaptation import exact_search
from ctgraph_rl.policies import RandomPolicy
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.kinds.task_like import TaskLike, are_tasks, close_env
from ctgraph_rl.tasks.protocol import Evaluation
from ctgraph_rl.tasks.task import Task


@torch.no_grad()
@takes_numbers
def evaluate(
    policy: Policy | nn.Module,
    tasks: Sequence[TaskLike],
    num_episodes: int = Evaluation.num_episodes,
    *,
    seed: int = 0,
    greedy: bool = Evaluation.greedy,
    episodes_per_row: int = Evaluation.episodes_per_row,
    initial_state: InitialState | None = None,
    device: torch.device | str = "cpu",
    curriculum: Curriculum | None = None,
) -> TensorDict:
    """Play the same number of episodes on every task, all in one batch.

    The environment is separate, and torch's global generator is left unchanged.

    Args:
        policy: what plays. A class such as `ctgraph_rl.policies.OptimalPolicy` is built on the environment; a plain
            module maps observations to logits, see `LogitsPolicy`.
        seed: of the environment and, if not greedy, of the policy's draws.
        greedy: take the most likely actions; False samples and explores as in training.
        episodes_per_row: successive episodes of a row, a divisor of ``num_episodes``. Goals that change between
            episodes need more than one.
        initial_state: gives a recurrent policy's state for a number of environments.
        curriculum: whose task ids the policy sees, if its protocol shows them.

    Returns:
        ``episode_reward`` float32, ``step_count`` int64, ``outcome`` uint8 and ``leaf`` int64 at the ends of episodes,
        each [tasks, num_episodes, 1]; those of a row are adjacent. Only CT-graphs have the last two.

    Raises:
        ValueError: for values out of range, a task with changing goals and one episode a row, a reference policy built
            on another environment, and a module that gives no logits.

    Example:
        >>> from ctgraph_rl.policies import OptimalPolicy
        >>> from ctgraph_rl.tasks.configurations import ct_su_b1
        >>> evaluate(OptimalPolicy, [ct_su_b1()], num_episodes=10)["episode_reward"].mean().item()
        1.0
    """
    given: Any = as_tuple(tasks)
    rule = "tasks must be a list with at least one Task"
    require((given != (), f"{rule}, got none"), *are_tasks(rule, given))
    tasks = given
    Evaluation(num_episodes, greedy, episodes_per_row).check(tasks)
    bound = isinstance(policy, RandomPolicy)
    require((callable(policy), f"policy must be a function or a module that writes actions, got {policy!r:.80}"))
    require((not bound, f"{type(policy).__name__} acts in the environment that it was built on: give the class itself"))
    device = checked_device(device)
    rows: list[TaskLike] = []
    for task in tasks:
        rows += [task] * (num_episodes // episodes_per_row)
    if curriculum is None:
        env = type(tasks[0]).make_env(rows, seed, device=device)
    else:
        env = make_env(curriculum, rows, seed, device)
    exploration = ExplorationType.DETERMINISTIC if greedy else ExplorationType.RANDOM
    try:
        if isinstance(policy, type):
            known = isinstance(env, CTGraphEnv) or not issubclass(policy, RandomPolicy)
            fix = "it knows their hidden state; give a policy of your own"
            require((known, f"{policy.__name__} plays only CT-graphs: {fix}"))
            try:
                acts = policy(env)
            except TypeError as error:
                wanted = "policy must be a class that is built on an environment"
                raise ValueError(f"{wanted}, got {policy!r}: {error}") from error
        else:
            acts = as_policy(policy, num_actions(env))
        with torch.random.fork_rng(devices=[env.device] if env.device.type == "cuda" else []):
            torch.manual_seed(seed)
            with set_exploration_type(exploration):
                result = _first_episodes(env, acts, initial_state, episodes_per_row)
    finally:
        close_env(env)
    return result.view(len(tasks), num_episodes)


def num_actions(env: EnvBase) -> int | None:
    """Return the number of actions; None where they are continuous."""
    return getattr(env.action_spec_unbatched, "n", None)


def _first_episodes(env: EnvBase, policy: Policy, initial_state: InitialState | None, num_episodes: int) -> TensorDict:
    start = make_start(env, initial_state)
    first = env.reset().update(start)
    data = dict(first.items(True, True))
    hidden = getattr(env, "ends", {})
    after = ("next", ENDS) if hidden else ("next",)
    first = TensorDict(hidden, env.batch_size) if hidden else first
    result = first.select("episode_reward", "step_count", "outcome", "leaf", strict=False)
    result = result.unsqueeze(-1).expand(env.numel(), num_episodes).clone()
    played = torch.zeros(env.batch_size, dtype=torch.int64, device=env.device)
    while (played < num_episodes).any():
        step, data = act(env, policy, data, start)
        ends = (step[*after, "done"].squeeze(-1) & (played < num_episodes)).nonzero().squeeze(-1)
        for key, value in result.items():
            value[ends, played[ends]] = step[*after, key][ends]
        played[ends] += 1
    return result


EPISODE_KEYS = ("episode_reward", "outcome", "step_count")


def means_by_part(ends: TensorDictBase, counts: Sequence[int]) -> list[NamedValues]:
    """Return the count of episodes, their mean return and length, and the shares that reach the goal and any end.

    Means are NaN without an episode; shares are NaN for other tasks than CT-graphs.

    Args:
        ends: data of the last step of each episode.
        counts: the sizes of successive parts, each with a result.
    """
    outcome = ends.get("outcome", None)
    values = {
        "return_mean": ends["episode_reward"],
        "success_rate": None if outcome is None else outcome == OUTCOME_GOAL,
        "end_rate": None if outcome is None else outcome != OUTCOME_FAIL,
        "length_mean": ends["step_count"],
    }
    found: list[NamedValues] = [{"episodes": count} for count in counts]
    for name, value in values.items():
        means = [math.nan] * len(counts)
        if value is not None:
            means = torch.stack([part.mean() for part in value.cpu().double().split([*counts])]).tolist()
        for part, mean in zip(found, means, strict=True):
            part[name] = mean
    return found


def adaptation(rows: TensorDictBase, task: TaskLike) -> Iterator[NamedValues]:
    """Yield the means over rows of their first episodes, of their second ones, and onwards.

    ``found_rate`` is the share of rows that have reached the goal by then, ``exact_rate`` that of the best search for a
    uniformly drawn goal; NaN for other tasks than CT-graphs.

    Args:
        rows: data of the last step of each episode, [rows, episodes of a row].
    """
    num_rows, num_steps = rows.shape
    exact = found = torch.full([num_steps], math.nan, dtype=torch.float64, device="cpu")
    if isinstance(task, Task):
        exact = exact_search(task.graph.num_end_states, num_steps)
        reached = (rows["outcome"] == OUTCOME_GOAL).view(num_rows, num_steps)
        found = reached.cummax(dim=1).values.double().mean(dim=0)
    for step, episodes in enumerate(rows.unbind(1)):
        rates = {"found_rate": found[step].item(), "exact_rate": exact[step].item()}
        [means] = means_by_part(episodes, [num_rows])
        yield {"step": step + 1, **means, **rates}


def derive_seed(seed: int, *purpose: str | int) -> int:
    """Return a seed in [0, 2**63) that is independent of the run's and of other purposes'."""
    text = "/".join(map(str, (seed, *purpose)))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


class Evaluator:
    """Evaluates as a curriculum says, and appends the results to a log.

    Args:
        seed: of the run; each evaluation derives one.
        untrained: the agent's policy before any training, which a stream evaluates on each new task, too.
    """

    def __init__(
        self,
        curriculum: Curriculum,
        seed: int,
        log: RunLog,
        device: torch.device | str = "cpu",
        untrained: Policy | None = None,
    ) -> None:
        self.curriculum = curriculum
        self.seed = seed
        self.log = log
        self.device = device
        self.untrained = untrained
        self._shared: tuple[object, EnvBase] | None = None

    def make_shared_env(self, tasks: Iterable[TaskLike], count: int) -> EnvBase:
        """Return an environment of as many members; it is kept for the next evaluation."""
        rows: list[TaskLike] = []
        for task in tasks:
            rows += [task] * self.num_rows
        if self._shared is None or self._shared[0] != (rows, count):
            self._shared = (rows, count), make_env(self.curriculum, rows * count, self.seed, self.device)
        return self._shared[1]

    def evaluate_if_due(self, agent: Agent, frames: int) -> None:
        """Evaluate an agent if the curriculum evaluates after ``frames`` frames of the run."""
        moment = self.curriculum.moment(frames)
        if moment is None:
            return
        tasks = self.tasks_at(frames)
        policies = task_policies(agent, self.curriculum, self.log, tasks, frames)
        if self.curriculum.evaluation.exact:
            measure([self], policies, frames, moment, initial_state=agent.initial_state)
            return
        policy = _join_policies(agent, policies)
        acts = policy.__call__ if isinstance(policy, nn.Module) else policy  # reads TensorDicts whatever it is
        self.evaluate(acts, frames, moment, agent.initial_state)

    def evaluate(self, policy: Policy, frames: int, moment: str, initial_state: InitialState | None = None) -> None:
        """Evaluate a policy and append one line for each task."""
        tasks = self.tasks_at(frames)
        curriculum = self.curriculum
        if not tasks:
            return
        how = curriculum.evaluation
        if how.exact:
            measure([self], [policy] * len(tasks), frames, moment, initial_state=initial_state)
            return
        result = evaluate(
            policy,
            list(tasks),
            self.num_rows * how.row_episodes,
            seed=derive_seed(self.seed, "evaluation", frames),
            greedy=how.greedy,
            episodes_per_row=how.row_episodes,
            initial_state=initial_state,
            device=self.device,
            curriculum=curriculum,
        )
        log_evaluation([self], result, frames, moment)

    @property
    def num_rows(self) -> int:
        """Rows that play a task."""
        how = self.curriculum.evaluation
        return how.num_episodes // how.episodes_per_row

    def _append(self, named: tuple[int, str], frames: int, moment: str) -> Callable[..., None]:
        number, label = named
        curriculum = self.curriculum
        return partial(
            self.log.append,
            moment=moment,
            block=curriculum.block_at(frames),
            frames=frames,
            task=number,
            label=label,
            held_out=number > len(curriculum.tasks),
        )

    def tasks_at(self, frames: int) -> dict[TaskLike, tuple[int, str]]:
        """Return the tasks to evaluate after ``frames`` frames, with their numbers and labels."""
        return self.curriculum.evaluated(frames)


def log_evaluation(evaluators: Sequence[Evaluator], result: TensorDictBase, frames: int, moment: str) -> None:
    """Append the lines of an evaluation of members.

    Args:
        result: data of the last step of each episode; those of a row, the rows of a task, the tasks of a member and
            the members are adjacent.
    """
    first = evaluators[0]
    how = first.curriculum.evaluation
    tasks = first.tasks_at(frames)
    rows = result.reshape(-1, how.row_episodes)
    counts = [how.num_episodes] * (len(evaluators) * len(tasks))
    measured = iter(means_by_part(rows[:, how.adapt_episodes :].reshape(-1), counts))
    of_task = iter(rows.split(first.num_rows))
    for evaluator in evaluators:
        for task, named in tasks.items():
            append = evaluator._append(named, frames, moment)
            append("evaluation", **next(measured))
            for step in adaptation(next(of_task), task) if how.adapt_episodes else ():
                append("adaptation", **step)


def measure(
    evaluators: Sequence[Evaluator],
    policies: Sequence[Any],
    frames: int,
    moment: str,
    *,
    initial_state: InitialState | None,
    failed: Collection[int] = (),
) -> None:
    """Append the lines of an exact evaluation of members.

    Args:
        policies: for each task; have ``action_probs`` of as many adjacent rows of each member.
        failed: positions of those that get no line.
    """
    first = evaluators[0]
    curriculum = first.curriculum
    shape = agent_specs(curriculum).observation["observation"].shape
    measures = partial(measures_by_seed, greedy=curriculum.evaluation.greedy, initial_state=initial_state)
    for (task, named), policy in zip(first.tasks_at(frames).items(), policies, strict=True):
        shown = ShownTask(task, shape, shown_id(curriculum, task))  # type: ignore[arg-type]
        is_next = named[0] == curriculum.block_at(frames) + 1 > 1
        for number, found in enumerate(measures(policy, len(evaluators), shown)):
            if number in failed:
                continue
            evaluator = evaluators[number]
            untrained = {}
            if evaluator.untrained is not None and is_next:
                [before] = measures(evaluator.untrained, 1, shown)
                untrained["untrained_return"] = before.return_mean
            append = evaluator._append(named, frames, moment)
            append("evaluation", episodes=None, **vars(found), exact=True, **untrained)


ROWS_AT_ONCE = 2**18
"""Most rows of members that are evaluated together and act in turn."""


@torch.no_grad()
def evaluate_together(
    evaluators: Sequence[Evaluator],
    agents: Sequence[Agent],
    frames: int,
    moment: str,
    policy: Policy | None = None,
    logged: Collection[int] | None = None,
) -> None:
    """Evaluate members of one curriculum of CT-graphs in one environment, with the bits of one at a time.

    Args:
        policy: acts for all members, each with as many adjacent rows, and greedily; None: each acts in turn.
        logged: positions of those whose lines are appended; None: all.
    """
    first = evaluators[0]
    curriculum = first.curriculum
    tasks = first.tasks_at(frames)
    how = curriculum.evaluation
    count = len(tasks) * first.num_rows
    most = len(evaluators) if policy is not None else max(1, ROWS_AT_ONCE // max(1, count))
    if len(evaluators) > most:
        for start in range(0, len(evaluators), most):
            some = slice(start, start + most)
            evaluate_together(evaluators[some], agents[some], frames, moment)
        return
    if not tasks:
        return
    seeds = [derive_seed(each.seed, "evaluation", frames) for each in evaluators]
    if policy is None:
        policies = []
        for evaluator, agent in zip(evaluators, agents, strict=True):
            own = task_policies(agent, curriculum, evaluator.log, tasks, frames)
            policies.append(_join_policies(agent, own))
        policy = InTurn(policies, seeds)  # type: ignore[assignment]  # acts on tensors
    assert policy is not None
    env = first.make_shared_env(tasks, len(evaluators))
    streams = torch.tensor(seeds, dtype=torch.int64, device=env.device).repeat_interleave(count)
    env.rows.set_streams(streams, torch.arange(count, device=env.device).repeat(len(evaluators)))
    exploration = ExplorationType.DETERMINISTIC if how.greedy else ExplorationType.RANDOM
    with torch.random.fork_rng(devices=[]), set_exploration_type(exploration):
        result = _first_episodes(env, policy, agents[0].initial_state, how.row_episodes)
    if logged is not None:
        result = result.view(len(evaluators), -1)[[*logged]]
        evaluators = [evaluators[number] for number in logged]
    log_evaluation(evaluators, result, frames, moment)


class InTurn:
    """A policy of equal slices of rows, each with a separate generator."""

    def __init__(self, policies: Sequence[Policy], seeds: Sequence[int]) -> None:
        self.policies = policies
        self.states = [torch.Generator(device="cpu").manual_seed(seed).get_state() for seed in seeds]

    def act_on_tensors(self, data: Step) -> Step:
        """Return what the policies write."""
        parts = {key: value.chunk(len(self.policies)) for key, value in data.items()}
        written = []
        for number, policy in enumerate(self.policies):
            torch.set_rng_state(self.states[number])
            own = {key: value[number] for key, value in parts.items()}
            written.append(acted(policy, own, data["observation"].device))
            self.states[number] = torch.get_rng_state()
        return {key: torch.cat([each[key] for each in written]) for key in written[0]}


def _join_policies(agent: Agent, policies: Sequence[Policy]) -> Policy:
    return agent.policy if all(policy is agent.policy for policy in policies) else by_slices(policies)


def by_slices(policies: Sequence[Policy]) -> Policy:
    """Return a policy that splits the rows into equal slices, one for each policy."""

    def act(data: TensorDictBase) -> TensorDictBase:
        slices = data.chunk(len(policies))
        return torch.cat([policy(part) for policy, part in zip(policies, slices, strict=True)])

    return act


def task_policies(
    agent: Any, curriculum: Curriculum, log: RunLog, tasks: Iterable[TaskLike], frames: int | None = None
) -> list[TensorDictModuleBase]:
    """Return an agent's policy for each task: the one for its id where ids are shown, else one for all.

    An agent that labels tasks has ``policy_for_label``, which gets the task's most frequent label.

    Args:
        tasks: what is played. An untrained one has no id and no label, and is played with `Agent.policy`.
        frames: of the run so far, while it lasts. If the present task started after the log's last interval, it has the
            label that acts.
    """
    if hasattr(agent, "policy_for_label"):
        labels = task_labels(log, curriculum)
        if frames:
            for number in curriculum.trained[curriculum.block_at(frames) - 1]:
                labels.setdefault(number, agent.label)
        position = {task: number for number, task in enumerate(curriculum.tasks)}
        return [agent.policy_for_label(labels.get(position[t])) if t in position else agent.policy for t in tasks]
    ids = {} if curriculum.protocol.task_id == "hidden" else curriculum.task_ids
    return [agent.policy_for(ids[task]) if task in ids else agent.policy for task in tasks]
