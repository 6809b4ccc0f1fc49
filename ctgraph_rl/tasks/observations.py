"""X: which observation id a state shows.

Section 2.4 of the paper; id ranges are inclusive, as in its JSON (W_IDs, D_IDs, graph_ends).
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import combinations
from typing import TypeGuard, TypeVar

from torch import Tensor

from ctgraph_rl.checks import Rule, as_tuple, is_int, make_fields_plain, require, true_or_false
from ctgraph_rl.core.graph import CTGraph, StateType

Ids = tuple[int, int]

Number = TypeVar("Number", int, Tensor)

MAX_READ_ROTATION = 359


@dataclass(frozen=True)
class Observations:
    """The observation process X: the ids of each kind of state, and the variation on read.

    Fully observable: ``unique_decisions`` and ``unique_waits`` (MDP_D, MDP_W of the paper). Surjective: ranges of
    one id. Confounding: longer ranges without uniqueness; an id is then drawn for every observation.

    Args:
        wait_ids: O^W.
        decision_ids: O^D.
        end_ids: O^E.
        home_ids: O^H.
        fail_ids: O^F.
        unique_waits: each wait state has its own id.
        unique_decisions: likewise.
        unique_ends: likewise; None: when waits or decisions have.
        read_noise: each pixel gains an integer drawn from 0..read_noise, saturating at 255.
        read_rotation: images are rotated by a whole number of degrees drawn from 0..read_rotation.
        reward_cue: a square in the middle of end images shows what was paid, by its brightness.
        legacy_index: number unique ids as the authors' implementation does: a state after k decisions, number j of the
            b^k of its level, gets id (b^k - 1 + j) modulo the size of its range. For b >= 3 states share ids in ranges
            of their number, and end states do not begin with the first id.
        noise_before_rotation: as in the authors' implementation.
        cue_wraps: the cue's brightness is taken modulo 256, as there, instead of saturating.

    Raises:
        ValueError: for reversed or overlapping ranges, and values out of range.
    """

    wait_ids: Ids
    decision_ids: Ids
    end_ids: Ids
    home_ids: Ids = (0, 0)
    fail_ids: Ids = (1, 1)
    unique_waits: bool = False
    unique_decisions: bool = False
    unique_ends: bool | None = None
    read_noise: int = 0
    read_rotation: int = 0
    reward_cue: bool = False
    legacy_index: bool = False
    noise_before_rotation: bool = False
    cue_wraps: bool = False

    def __post_init__(self) -> None:
        make_fields_plain(self)
        if self.unique_ends is None:
            object.__setattr__(self, "unique_ends", bool(self.unique_decisions or self.unique_waits))
        ranges = {}
        rules = []
        flags = {}
        for field in fields(self):
            name = field.name
            value = as_tuple(getattr(self, name))
            if name.endswith("_ids"):
                object.__setattr__(self, name, value)
                rules.append((_is_range(value), f"{name} must be (first, last) with 0 <= first <= last, got {value!r}"))
                if _is_range(value):
                    ranges[name] = value
            elif "bool" in field.type:
                flags[name] = value
        ordered = sorted(ranges.items(), key=lambda item: item[1])
        for (low_name, low), (high_name, high) in combinations(ordered, 2):
            overlaps = f"{high_name}={high} overlaps {low_name}={low}; let it start at {low[1] + 1} or later"
            rules.append((high[0] > low[1], overlaps))
        rotation = self.read_rotation
        degrees = f"read_rotation must be whole degrees in 0..{MAX_READ_ROTATION}, got {rotation!r}"
        require(
            *rules,
            *true_or_false(**flags),
            (is_int(self.read_noise, 0, 255), f"read_noise must be an integer in 0..255, got {self.read_noise!r}"),
            (is_int(rotation, 0, MAX_READ_ROTATION), degrees),
        )

    def ids(self, kind: StateType) -> Ids:
        """Ids of a kind of state."""
        return getattr(self, f"{kind.name.lower()}_ids")

    def is_unique(self, kind: StateType) -> bool:
        """Whether each state of this kind has its own id."""
        return bool(getattr(self, f"unique_{kind.name.lower()}s", False))

    @property
    def last_id(self) -> int:
        """The highest id in use."""
        return max(self.ids(kind)[1] for kind in StateType)

    @property
    def draws_ids(self) -> bool:
        """Whether any kind of state shows an id drawn from several."""
        return any(not self.is_unique(kind) and self.ids(kind)[0] < self.ids(kind)[1] for kind in StateType)

    def unique_id(self, graph: CTGraph, kind: StateType, level: int, number: Number) -> Number:
        """Return the id of a state that has its own, by its number, or those of several, within a level of the tree."""
        before = 0 if kind == StateType.END else graph.first_node(level)
        if self.legacy_index:
            before = graph.branching_factor**level - 1
        first, last = self.ids(kind)
        return first + (before + number) % (last - first + 1)

    def rules(self, graph: CTGraph) -> list[Rule]:
        """Return the rules on a graph: unique ids need an id per state."""
        found = []
        for kind in filter(self.is_unique, StateType):
            name = kind.name.lower()
            count = getattr(graph, f"num_{name}_states")
            first, last = self.ids(kind)
            need = f"unique_{name}s needs {count} {name}_ids, got {last - first + 1} in ({first}, {last})"
            found.append((last - first + 1 >= count, f"{need}; use ({first}, {first + count - 1})"))
        return found


def _is_range(value: object) -> TypeGuard[Ids]:
    return isinstance(value, tuple) and len(value) == 2 and is_int(value[0], 0) and is_int(value[1], value[0])
