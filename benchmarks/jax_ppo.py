"""PPO and LSTM-PPO in JAX, in PureJaxRL's form: a compiled function acts for a batch and learns from it.

For `benchmarks.agents`, with our hyperparameters, network and losses. Its environment looks up all action sequences in
a table, so it is nearly free, and a task must not draw numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from types import SimpleNamespace
from typing import Any

import jax
import torch
from jax import lax, nn, random, tree
from jax import numpy as jnp

from ctgraph_rl import CTGraphEnv, Task

Arrays = Any
"""Arrays of JAX, in tuples and dictionaries."""


class JAX:
    """A learner in JAX; arguments as in `benchmarks.stable.Stable`."""

    def __init__(self, name: str, given: Mapping[str, Any], task: Task, seed: int) -> None:
        self.given = SimpleNamespace(**given)
        self.memory = name == "lstm_ppo"
        self.length = 2 * task.graph.depth + 2
        self.count = task.graph.branching_factor + 1
        actions = torch.tensor(list(product(range(self.count), repeat=self.length)), dtype=torch.int64, device="cpu")
        env = CTGraphEnv([task] * len(actions), 0)
        data = env.reset()
        shown = [data["observation"].flatten(1)]
        ends = []
        for action in actions.unbind(1):
            step, data = env.step_and_maybe_reset(data.set("action", action))
            after = step["next"]
            shown.append(after["observation"].flatten(1))
            ends.append(torch.cat([after["reward"], after["done"].float()], dim=1))
        self.images = jnp.asarray(torch.stack(shown).numpy())  # [time, sequence, pixel]
        self.ends = jnp.asarray(torch.stack(ends).numpy())  # [time, sequence, reward and whether it ends]
        width = given["hidden_size"]
        of_second = (2 * width, 4 * width) if self.memory else (width, width)
        weights = []
        torch.manual_seed(seed)
        for size in ((self.images.shape[2], width), of_second, (width, self.count), (width, 1)):
            weights.append([jnp.asarray(part.detach().numpy().T) for part in torch.nn.Linear(*size).parameters()])
        zeros = tree.map(jnp.zeros_like, weights)
        rows = given["num_envs"]
        begin = (*jnp.zeros((2, rows), int), *jnp.zeros((2, rows, width)))
        self.state = (random.key(seed), (weights, zeros, zeros, 0), begin)
        self.run = jax.jit(self.update)

    def learn(self) -> int:
        """Act for a batch, and learn from it."""
        self.state, self.reward = jax.block_until_ready(self.run(self.state))
        return self.given.num_envs * self.given.num_steps

    def success(self) -> float:
        """Return the share of the last batch's episodes that reached the goal, which are not greedy."""
        return self.reward * self.length

    def outputs(self, weights: Arrays, frame: Arrays, memory: Arrays) -> tuple[Arrays, Arrays]:
        """Return the next memory, and log-probabilities and values of a step; without memory, of all steps."""
        (first, at_first), (second, at_second), (actor, at_actor), (critic, at_critic) = weights
        features = nn.relu(frame["image"] / 255.0 @ first + at_first)
        if self.memory:
            h, c = (jnp.where(frame["starts"][:, None], 0, part) for part in memory)
            i, f, g, o = jnp.split(jnp.concatenate([features, h], axis=1) @ second + at_second, 4, axis=1)
            c = nn.sigmoid(f) * c + nn.sigmoid(i) * jnp.tanh(g)
            features = nn.sigmoid(o) * jnp.tanh(c)
            memory = [features, c]
        else:
            features = nn.relu(features @ second + at_second)
        return memory, (nn.log_softmax(features @ actor + at_actor), (features @ critic + at_critic)[..., 0])

    def loss(self, weights: Arrays, frames: Arrays, memory: Arrays) -> Arrays:
        """Return the loss of frames, [n] or with memory [steps, rows]."""
        given = self.given
        if self.memory:
            _, (log_probs, value) = lax.scan(lambda m, frame: self.outputs(weights, frame, m), memory, frames)
        else:
            _, (log_probs, value) = self.outputs(weights, frames, memory)
        taken = jnp.take_along_axis(log_probs, frames["action"][..., None], axis=-1)[..., 0]
        ratio = jnp.exp(taken - frames["log_prob"])
        clipped = ratio.clip(1 - given.clip_epsilon, 1 + given.clip_epsilon)
        gain = jnp.minimum(ratio * frames["advantage"], clipped * frames["advantage"])
        entropy = -(jnp.exp(log_probs) * log_probs).sum(axis=-1)
        error = (value - frames["target"]) ** 2
        return (given.critic_coeff * error - gain - given.entropy_coeff * entropy).mean()

    def collect(self, weights: Arrays, key: Arrays, begin: Arrays) -> tuple[Arrays, Arrays]:
        """Return where all rows stand after a batch, and its frames with advantages."""
        given = self.given

        def act(carried: Arrays, key: Arrays) -> tuple[Arrays, Arrays]:
            time, sequence, *memory = carried
            frame = {"image": self.images[time, sequence], "starts": time == 0}
            memory, (log_probs, value) = self.outputs(weights, frame, memory)
            action = random.categorical(key, log_probs)
            sequence += action * self.count ** (self.length - 1 - time)
            reward, end = self.ends[time, sequence].T
            log_prob = jnp.take_along_axis(log_probs, action[:, None], axis=1)[:, 0]
            frame |= {"action": action, "log_prob": log_prob, "value": value, "reward": reward, "goes_on": 1 - end}
            return (jnp.where(end, 0, time + 1), jnp.where(end, 0, sequence), *memory), frame

        def look_back(carried: Arrays, frame: Arrays) -> tuple[Arrays, Arrays]:
            value, advantage = carried
            further = given.gamma * (value + given.gae_lambda * advantage) * frame["goes_on"]
            advantage = frame["reward"] + further - frame["value"]
            return (frame["value"], advantage), advantage

        after, frames = lax.scan(act, begin, random.split(key, given.num_steps))
        _, last = act(after, key)
        _, advantage = lax.scan(look_back, (last["value"], 0 * last["value"]), frames, reverse=True)
        return after, frames | {"advantage": advantage, "target": advantage + frames["value"]}

    def update(self, state: Arrays) -> tuple[Arrays, Arrays]:
        """Return the state after a batch, and its mean reward."""
        given = self.given
        key, learner, begin = state
        key, acting, *orders = random.split(key, 2 + given.num_epochs)
        after, frames = self.collect(learner[0], acting, begin)
        axis = int(self.memory)
        if not axis:
            frames = tree.map(lambda part: part.reshape(-1, *part.shape[2:]), frames)

        def descend(learner: Arrays, places: Arrays) -> tuple[Arrays, None]:
            weights, first, second, count = learner
            chosen = tree.map(lambda part: part.take(places, axis=axis), frames)
            memory = [part[places] for part in begin[2:]] if axis else None
            gradient = jax.grad(self.loss)(weights, chosen, memory)
            norm = sum((part**2).sum() for part in tree.leaves(gradient)) ** 0.5
            gradient = tree.map(lambda g: g * jnp.minimum(given.max_grad_norm / (norm + 1e-6), 1), gradient)
            first = tree.map(lambda m, g: 0.9 * m + 0.1 * g, first, gradient)
            second = tree.map(lambda v, g: 0.999 * v + 0.001 * g**2, second, gradient)
            rate = given.learning_rate / (1 - 0.9 ** (count + 1))
            scale = 1 / (1 - 0.999 ** (count + 1))
            moved = tree.map(lambda w, m, v: w - rate * m / ((v * scale) ** 0.5 + 1e-8), weights, first, second)
            return (moved, first, second, count + 1), None

        orders = [random.permutation(order, frames["action"].shape[axis]) for order in orders]
        minibatches = jnp.concatenate(orders).reshape(given.num_epochs * given.num_minibatches, -1)
        learner, _ = lax.scan(descend, learner, minibatches)
        return (key, learner, after), frames["reward"].mean()
