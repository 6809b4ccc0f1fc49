"""PENN-A: a population of plastic neuromodulated networks evolves, and each learns within its life, without gradients.

Ben-Iwhiwhu et al. 2020, "Evolving inborn knowledge for fast adaptation in dynamic POMDP problems" (GECCO, arXiv
2004.12846). An individual lives several trials, a row each. Its fitness is the mean sum of rewards over
``life_episodes`` episodes. It gets no reward, but sees the image of an end state.

Observations become 16 latents of an autoencoder, logit(l / max l) clipped to [0, 1]. They and a constant 1 are the
inputs of neurons. The first neuron acts: an output above 1/3 is action 2, one below -1/3 action 1, else 0. At each
step, five times, with x the inputs and the last outputs with a little noise,

    y_i = tanh(1/2 sum over inputs and standard j of w_ji x_j),  m_i = tanh(1/2 sum over modulatory j of w_ji x_j),
    w_ji <- clip(w_ji + m_i r (A z_j y_i + B z_j + C y_i + D), -10, 10),  z the inputs and y without noise.

Weights from modulatory neurons stay. A gene g gives w = 10 g^3; a weight below 0.1 is 0 and stays 0. Likewise A to D,
g^3 or 0 below 0.01, and r = 100 g^3. A life begins with these weights.

After a generation the population is cut into segments at a random place. The best of a segment has all its children:
clones or crossed with a random individual. Then a neuron may be inserted, one duplicated, one deleted, and genes are
mutated by +-exp(-180 |u|), u uniform in [-1, 1]. A new neuron is standard or modulatory with equal probability, with
genes of 0. Individuals before the first segment have a child each. The best of all stays as individual 0. The first
generation's weights are mutated zeros, with 10 in place of 180, its rule's genes uniform. The autoencoder learns from
what the population saw.

A greedy evaluation plays the best individual, one that samples the population in turns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn.functional import mse_loss, pad
from torchrl.data import Composite, TensorSpec
from typing_extensions import override

from baselines.cells.cell import linear_layer
from baselines.parts.networks import Data, TensorsByName, guided, highest, is_greedy, num_actions_of, require_weights
from baselines.update.measured import require_finite
from baselines.update.update import minimise
from ctgraph_rl.checks import NamedValues, at_least_one, fraction, make_fields_plain, positive, require, require_memory
from ctgraph_rl.learn.collect import UNSTORED
from ctgraph_rl.learn.histories import distinct

PASSES = 5
NOISE = 0.001
THRESHOLD = 0.33
LARGEST_WEIGHT = 10.0

NEURONS = (False, False, False, False, True, True, True)
"""Which of the first individuals' neurons are modulatory; the first neuron acts."""

FIRST_PRECISION = 10.0

WEIGHTS = f"{UNSTORED}weights"
OUTPUTS = f"{UNSTORED}outputs"


class Population(NamedTuple):
    """Genomes, padded to the most neurons of an individual."""

    genes: Tensor  # of weights, [individuals, inputs + neurons, neurons]; 0 where there is no neuron
    rule: Tensor  # genes of A, B, C, D and r, [individuals, 5]
    modulates: Tensor  # which neurons are modulatory, bool [individuals, neurons]
    size: Tensor  # neurons, int64 [individuals]

    def take(self, individuals: Tensor) -> Population:
        """Return some individuals, int64 [n]."""
        return Population(*(value[individuals] for value in self))

    @property
    def num_inputs(self) -> int:
        """Inputs of a neuron beside the neurons."""
        return self.genes.shape[1] - self.genes.shape[2]

    def within(self, size: Tensor) -> Tensor:
        """Return which genes belong to the first ``size`` neurons of each individual, bool like ``genes``."""
        row = torch.arange(self.genes.shape[1], device=size.device).view(-1, 1)
        column = torch.arange(self.genes.shape[2], device=size.device)
        limit = size.view(-1, 1, 1)
        return (row < self.num_inputs + limit) & (column < limit)

    def weights(self) -> Tensor:
        """Return the weights at birth, like ``genes``."""
        weights = LARGEST_WEIGHT * self.genes**3
        return torch.where(weights.abs() < 0.1, 0.0, weights)

    def rates(self) -> Tensor:
        """Return A, B, C, D and r, [individuals, 5]."""
        cubes = self.rule**3
        of_terms = torch.where(cubes.abs() < 0.01, 0.0, cubes)[:, :4]
        return torch.cat([of_terms, 100 * cubes[:, 4:]], dim=1)


def live(lives: Population, inputs: Tensor, weights: Tensor, outputs: Tensor) -> tuple[Tensor, Tensor]:
    """Return weights and outputs after a step, computed with rows last, which is fastest.

    Args:
        inputs: of all neurons, [rows, inputs].
        weights: [rows, inputs + neurons, neurons].
        outputs: of the step before, [rows, neurons].
    """
    changing = weights.movedim(0, -1).clone(memory_format=torch.contiguous_format)
    inputs = inputs.T
    outputs = outputs.T
    modulates = pad(lives.modulates, (len(inputs), 0)).T.unsqueeze(1)
    plastic = ((changing != 0) & ~modulates).to(weights.dtype)
    a, b, c, d, rate = lives.rates().T
    for _ in range(PASSES):
        seen = torch.cat([inputs, outputs])
        seen = seen + NOISE * draw_like(seen)
        parts = seen.unsqueeze(1) * changing
        from_modulatory = (parts[len(inputs) :] * modulates[len(inputs) :]).sum(dim=0)
        outputs = ((parts.sum(dim=0) - from_modulatory) / 2).tanh()
        gain = (from_modulatory / 2).tanh() * rate
        sources = torch.cat([inputs, outputs]).unsqueeze(1)
        change = torch.addcmul(gain * (c * outputs + d), sources, gain * (a * outputs + b))
        changing.addcmul_(plastic, change).clamp_(-LARGEST_WEIGHT, LARGEST_WEIGHT)
    return changing.movedim(-1, 0), outputs.T


@dataclass(frozen=True, kw_only=True)
class Reproduction:
    """How a generation follows from the one before."""

    segment_size: int  # individuals of which the best one has all children
    crossover_prob: float  # probability of a child to be crossed with a random individual
    insert_prob: float  # probability of a child to get a new neuron
    duplicate_prob: float  # probability of a child to get a copy of a neuron
    delete_prob: float  # probability of a child to lose a neuron
    precision: float  # of mutations, see `mutation`

    def children(self, parents: Population, fitness: Tensor) -> Population:
        """Return the next generation, whose first individual is this one's best."""
        offset = torch.randint(self.segment_size, (), dtype=torch.int64, device="cpu")
        chosen = winners(fitness, self.segment_size, int(offset))
        chosen[0] = fitness.argmax()
        mates = torch.randint(len(fitness), fitness.shape, device=fitness.device)
        crossed = self.crossed(parents.take(chosen), parents.take(mates))
        return mutated(self.resized(crossed), self.precision)

    def crossed(self, parents: Population, mates: Population) -> Population:
        """Give some children a mate's genes from a random row on, as far as both have neurons."""
        crosses = chances(parents).view(-1, 1) < self.crossover_prob
        shared = torch.minimum(parents.size, mates.size)
        point = 1 + (chances(parents) * (parents.num_inputs + shared - 1)).floor().view(-1, 1)
        row = torch.arange(parents.genes.shape[1], device=point.device)
        from_mate = (crosses & (row >= point)).unsqueeze(-1) & parents.within(shared)
        swapped = crosses & (torch.rand_like(parents.rule) < 0.5)
        return parents._replace(
            genes=torch.where(from_mate, mates.genes, parents.genes),
            rule=torch.where(swapped, mates.rule, parents.rule),
        )

    def resized(self, population: Population) -> Population:
        """Insert, duplicate and delete a neuron of some individuals; the first neuron stays."""
        blank = torch.full_like(population.size, population.modulates.shape[1])
        population = grown(population, chances(population) < self.insert_prob, blank)
        population = grown(population, chances(population) < self.duplicate_prob, below(population.size))
        deletes = (chances(population) < self.delete_prob) & (population.size > 1)
        return shrunk(population, deletes, 1 + below(population.size - 1))


def chances(population: Population) -> Tensor:
    """Draw from [0, 1) for each individual, but 1 for the first, which stays as it was; [individuals]."""
    drawn = torch.rand_like(population.rule[:, 0])
    drawn[0] = 1
    return drawn


def below(count: Tensor) -> Tensor:
    """Draw an integer in [0, count), int64."""
    drawn = torch.rand(count.shape, dtype=torch.float32, device=count.device)
    return (drawn * count).long().minimum(count - 1)


def grown(population: Population, who: Tensor, model: Tensor) -> Population:
    """Give some individuals a neuron more.

    Args:
        population: of up to n neurons.
        who: which individuals, bool [individuals].
        model: the neuron to copy, but for the gene to itself; n: a new one, int64 [individuals].
    """
    place = torch.arange(population.modulates.shape[1] + 1, device=who.device)
    added = who.unsqueeze(-1) & (place == population.size.unsqueeze(-1))
    found = rearranged(population, torch.where(added, model.unsqueeze(-1), place), population.size + who.long())
    itself = pad(added.unsqueeze(1) & added.unsqueeze(2), (0, 0, population.num_inputs, 0))
    return found._replace(genes=found.genes.masked_fill(itself, 0))


def shrunk(population: Population, who: Tensor, lost: Tensor) -> Population:
    """Delete neurons, int64 [individuals], of some individuals, bool [individuals]; later ones move up."""
    size = population.size - who.long()
    place = torch.arange(int(size.max()), device=who.device)
    moves = who.unsqueeze(-1) & (place >= lost.unsqueeze(-1))
    return rearranged(population, place + moves.long(), size)


def rearranged(population: Population, source: Tensor, size: Tensor) -> Population:
    """Return individuals whose neurons are copies of others, or new.

    Args:
        population: of up to n neurons.
        source: the neuron that each copies, n for a new one, int64 [individuals, neurons].
        size: neurons of each individual.
    """
    inputs = population.num_inputs
    genes = pad(population.genes, (0, 1, 0, 1))
    modulates = pad(population.modulates, (0, 1))
    modulates[:, -1] = torch.rand_like(genes[:, 0, 0]) < 0.5
    always = torch.arange(inputs, device=size.device).expand(len(size), -1)
    rows = torch.cat([always, inputs + source], dim=1).unsqueeze(-1)
    genes = genes.take_along_dim(rows, dim=1).take_along_dim(source.unsqueeze(1), dim=2)
    found = Population(genes, population.rule, modulates.gather(1, source), size)
    return found._replace(genes=genes * found.within(size))


def draw_like(values: Tensor) -> Tensor:
    """Draw numbers uniformly from [-1, 1)."""
    return 2 * torch.rand_like(values) - 1


def mutation(genes: Tensor, precision: float) -> Tensor:
    """Draw changes of genes of either sign: P(|change| > x) = -ln(x) / precision for x above exp(-precision)."""
    drawn = draw_like(genes)
    return drawn.sign() * (-precision * drawn.abs()).exp()


def mutated(population: Population, precision: float) -> Population:
    """Mutate all genes of all individuals but the first."""
    genes = population.genes.clone()
    rule = population.rule.clone()
    for values in (genes[1:], rule[1:]):
        values.add_(mutation(values, precision)).clamp_(-1, 1)
    return population._replace(genes=genes * population.within(population.size), rule=rule)


def winners(fitness: Tensor, segment_size: int, offset: int) -> Tensor:
    """Return each child's parent, int64 [individuals]: itself before the offset, then its segment's best."""
    count = len(fitness)
    padding = (0, (offset - count) % segment_size)
    segments = pad(fitness[offset:], padding, value=-torch.inf).view(-1, segment_size)
    first = offset + segment_size * torch.arange(len(segments), device=fitness.device)
    best = (first + segments.argmax(dim=1)).repeat_interleave(segment_size)
    return torch.cat([torch.arange(offset, device=fitness.device), best])[:count]


def first_population(count: int, num_inputs: int) -> Population:
    """Draw the first generation; its first individual has no weights."""
    modulates = torch.tensor(NEURONS, dtype=torch.bool, device="cpu").repeat(count, 1)
    size = modulates.new_full((count,), len(NEURONS), dtype=torch.int64)
    genes = torch.zeros(count, num_inputs + len(NEURONS), len(NEURONS), dtype=torch.float32, device="cpu")
    return mutated(Population(genes, draw_like(genes[:, :5, 0]), modulates, size), FIRST_PRECISION)


def layers(*widths: int) -> nn.Sequential:
    """Return linear layers with ReLU."""
    found = nn.Sequential()
    for before, after in pairwise(widths):
        found.extend([linear_layer(before, after), nn.ReLU()])
    return found


class Autoencoder(nn.Module):
    """Observations to latents and back, with ReLU after all layers.

    Args:
        num_pixels: numbers of an observation.
        scale: divisor of observations.
        hidden_size: units between observation and latents.
    """

    def __init__(self, num_pixels: int, scale: float, hidden_size: int, num_latents: int) -> None:
        super().__init__()
        self.scale = scale
        self.encoder = layers(num_pixels, hidden_size, num_latents)
        self.decoder = layers(num_latents, hidden_size, num_pixels)

    def loss(self, observation: Tensor) -> Tensor:
        """Compute the mean squared error of observations, [n, ...]."""
        flat = observation.flatten(1) / self.scale
        return mse_loss(self.decoder(self.encoder(flat)), flat)

    def inputs(self, observation: Tensor) -> Tensor:
        """Return inputs of neurons, [n, num_latents + 1]; equal observations are encoded once."""
        examples, groups = distinct([observation])
        latents = self.encoder(observation[examples].flatten(1) / self.scale)
        share = latents / (latents.amax(dim=1, keepdim=True) + 1e-5)
        return pad(share.logit(1e-5).clamp(0, 1), (0, 1), value=1.0)[groups]


@dataclass(frozen=True, kw_only=True)
class PennASettings(Reproduction):
    """The settings of `PennA`, with those of `Reproduction`."""

    num_envs: int  # rows, num_trials for each individual
    num_steps: int  # steps of each row in a batch
    num_batches: int  # batches of a life
    num_trials: int  # trials of an individual, in rows that follow each other
    life_episodes: int  # episodes of a trial whose rewards count
    num_latents: int  # latents of the autoencoder
    hidden_size: int  # units of its other layers
    learning_rate: float  # of its gradient steps, which have momentum as published, not Adam
    num_updates: int  # gradient steps after a generation
    batch_size: int  # observations of each

    def __post_init__(self) -> None:
        make_fields_plain(self)
        require(
            *at_least_one(num_envs=self.num_envs, num_steps=self.num_steps, num_batches=self.num_batches),
            *at_least_one(num_trials=self.num_trials, life_episodes=self.life_episodes),
            *at_least_one(num_latents=self.num_latents, hidden_size=self.hidden_size, num_updates=self.num_updates),
            *at_least_one(batch_size=self.batch_size, segment_size=self.segment_size),
            *fraction(crossover_prob=self.crossover_prob, insert_prob=self.insert_prob),
            *fraction(duplicate_prob=self.duplicate_prob, delete_prob=self.delete_prob),
            *positive(learning_rate=self.learning_rate, precision=self.precision),
        )
        rows = f"num_envs must be a multiple of num_trials={self.num_trials}, the rows of an individual"
        fewest = self.segment_size * self.num_trials
        segment = f"num_envs must be at least segment_size={self.segment_size} individuals, {fewest} rows"
        require(
            (self.num_envs % self.num_trials == 0, f"{rows}, got {self.num_envs}"),
            (self.num_envs >= fewest, f"{segment}, got {self.num_envs}"),
        )


class PennA(TensorDictModuleBase):
    """A population that evolves and is its policy: each row has weights that last over a life's episodes."""

    Settings = PennASettings
    memory = True
    needs_episodes = True
    solves = "tasks whose goal changes within a life, if images show what was paid: it learns without a reward"
    in_keys = ["observation", "is_init", "trial", "life", WEIGHTS, OUTPUTS]  # noqa: RUF012, as TensorDict has it
    out_keys = ["action", *(("next", key) for key in in_keys[2:])]  # noqa: RUF012

    def __init__(self, observation_spec: Composite, action_spec: TensorSpec, **settings: Any) -> None:
        super().__init__()
        self.settings = given = PennASettings(**settings)
        num_actions = num_actions_of(action_spec)
        three = f"PENN-A has one neuron for the actions 0, 1 and 2, and the task has {num_actions}"
        require((num_actions == 3, three))
        require_weights(observation_spec, given.hidden_size, 2, given.num_latents)
        weights = given.num_envs * (given.num_latents + len(NEURONS)) * len(NEURONS)
        what = f"weights of num_envs={given.num_envs} with num_latents={given.num_latents}"
        require_memory(what, 16 * weights, "of either")
        self.num_envs = given.num_envs
        self.num_steps = given.num_steps
        shown = observation_spec["observation"]
        self.autoencoder = Autoencoder(shown.shape.numel(), highest(shown), given.hidden_size, given.num_latents)
        self.optimiser = torch.optim.SGD(self.parameters(), lr=given.learning_rate, momentum=0.9)
        self.population = first_population(given.num_envs // given.num_trials, given.num_latents + 1)
        self.generation = 0
        self.lived = 0
        self.register_buffer("rewards", torch.zeros(given.num_envs, dtype=torch.float32, device="cpu"))

    @property
    def policy(self) -> TensorDictModuleBase:
        """The agent itself."""
        return self

    def policy_for(self, task: int) -> TensorDictModuleBase:
        """Return the policy, the same for all tasks."""
        return self

    def start_task(self, task: int | None = None) -> None:
        """Do nothing."""

    def end_task(self) -> None:
        """Do nothing."""

    def initial_state(self, num_envs: int) -> TensorDict:
        """Return the state before a life, which lasts over episodes by its key ``trial``."""
        genes = self.population.genes
        none = genes.new_zeros(num_envs, 1, dtype=torch.int64)
        weights = genes.new_zeros(num_envs, *genes.shape[1:])
        return TensorDict({"trial": none, "life": none, WEIGHTS: weights, OUTPUTS: weights[:, 0]}, [num_envs])

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` and the next state; ``trial`` is the episode's number in its life, from 1."""
        rows = torch.arange(len(tensordict), device=tensordict["trial"].device)
        who = torch.zeros_like(rows) if is_greedy() else rows // self.settings.num_trials % len(self.population.size)
        lives = self.population.take(who)
        waits = (tensordict["life"] != self.generation) | (tensordict["trial"] == 0)  # for its first episode
        trial = torch.where(waits, 0, tensordict["trial"]) + tensordict["is_init"]
        weights = tensordict[WEIGHTS]
        outputs = tensordict[OUTPUTS]
        if waits.any():
            born = lives.weights()
            if waits.all():  # at the start of a generation, whose individuals may have more neurons
                weights = born
                outputs = torch.zeros_like(born[:, 0])
            else:
                weights = torch.where(waits.unsqueeze(-1), born, weights)
                outputs = torch.where(waits, 0.0, outputs)
        inputs = self.autoencoder.inputs(tensordict["observation"])
        weights, outputs = live(lives, inputs, weights, outputs)
        output = outputs[:, 0] + NOISE * draw_like(outputs[:, 0])
        action = 2 * (output > THRESHOLD) + 1 * (output < -THRESHOLD)
        tensordict.set("action", guided(tensordict, action))
        after = {"trial": trial, "life": torch.full_like(trial, self.generation), WEIGHTS: weights, OUTPUTS: outputs}
        return tensordict.update({("next", key): value for key, value in after.items()})

    def loss(self, batch: Data) -> TensorsByName:
        """Return the autoencoder's loss."""
        return {"loss_autoencoder": self.autoencoder.loss(batch["observation"])}

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Add up rewards; after a life's last batch, the population reproduces and the autoencoder learns."""
        after = batch["next"]
        is_born = (after["life"] == self.generation) & (after["trial"] > 0)
        self.rewards += (after["reward"] * (is_born & (after["trial"] <= self.settings.life_episodes))).sum(dim=(1, 2))
        self.lived += 1
        if self.lived < self.settings.num_batches:
            return {}
        fitness = self.rewards.view(-1, self.settings.num_trials).mean(dim=1)
        seen = batch["observation"].flatten(0, 1)
        total = torch.zeros_like(self.rewards[0])
        for _ in range(self.settings.num_updates):
            drawn = torch.randint(len(seen), (self.settings.batch_size,), device=seen.device)
            loss = self.autoencoder.loss(seen[drawn])
            minimise(self.optimiser, loss)
            total += loss.detach()
        require_finite("loss_autoencoder", total)
        measured = {
            "fitness_mean": fitness.mean().item(),
            "fitness_best": fitness.max().item(),
            "neurons_mean": self.population.size.double().mean().item(),
            "loss_autoencoder": total.item() / self.settings.num_updates,
        }
        self.population = self.settings.children(self.population, fitness)
        self.generation += 1
        self.lived = 0
        self.rewards.zero_()
        return measured

    @override
    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> PennA:
        self.population = Population(*map(fn, self.population))
        return super()._apply(fn, recurse)

    @override
    def get_extra_state(self) -> NamedValues:
        state = {"population": self.population._asdict(), "generation": self.generation, "lived": self.lived}
        state["optimiser"] = self.optimiser.state_dict()
        return state

    @override
    def set_extra_state(self, state: NamedValues) -> None:
        self.population = Population(**state["population"])
        self.generation = state["generation"]
        self.lived = state["lived"]
        self.optimiser.load_state_dict(state["optimiser"])
