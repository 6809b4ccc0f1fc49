"""Observations, rewards, ends and actions of Gymnasium's environments, read at one place."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctgraph_rl.checks import plain, require

CHANNELS = (1, 3, 4)

LARGEST = float(np.finfo(np.float32).max)


def is_discrete(space: Any) -> bool:
    """Return whether a space is Gymnasium's ``Discrete``."""
    from gymnasium.spaces import Discrete

    return isinstance(space, Discrete)


def is_box(space: Any) -> bool:
    """Return whether a space is Gymnasium's ``Box``."""
    from gymnasium.spaces import Box

    return isinstance(space, Box)


class Taken(NamedTuple):
    """What a step returned."""

    observation: NDArray[Any]
    reward: float
    terminated: bool
    truncated: bool


class ObservationForm:
    """How a network sees the observations of a space.

    - Integers, ``Discrete``: one-hot, uint8 [n].
    - A ``Box`` of one dimension: a vector, uint8 [n] if the space is uint8, else float32 [n].
    - A uint8 ``Box`` of two dimensions: a grey image [height, width], shown as [1, height, width].
    - Of three: an image with channels, shown channels first. These are the first or the last axis: the one of length 1,
      3 or 4; else ``channels`` says which.
    - Of four: frames [frames, ...] of images with channels, as by ``FrameStackObservation``. All are shown as channels,
      the oldest frame first.

    Args:
        channels: where an image has its channels, ``first`` or ``last``; None: by the rule above.

    Raises:
        ValueError: for other spaces, with the wrapper to add, and images whose channels are unclear.
    """

    def __init__(self, space: Any, channels: str | None = None) -> None:
        self.space = space
        self.axes: tuple[int, ...] | None = None
        self.is_integer = is_discrete(space)
        self.largest = 1 if self.is_integer else 255
        if self.is_integer:
            self.shape: tuple[int, ...] = (int(space.n),)
            self.dtype: Any = np.uint8
            return
        shown = is_box(space) and (len(space.shape) == 1 or (len(space.shape) in (2, 3, 4) and space.dtype == np.uint8))
        if getattr(space, "is_np_flattenable", False):
            fix = "add the wrapper gymnasium.wrappers:FlattenObservation, or one of your own"
        else:
            fix = "add a wrapper of your own, a gymnasium.ObservationWrapper that returns an array"
        if is_box(space) and len(space.shape) in (2, 3) and (space.low >= 0).all() and (space.high > 1).any():
            as_uint8 = "gymnasium.wrappers:DtypeObservation with {'dtype': 'uint8'}"
            fix = f"for images add the wrapper {as_uint8}, for vectors gymnasium.wrappers:FlattenObservation"
        require((shown, f"shows {_in_words(space)}, which cannot be stacked as images or vectors: {fix}"))
        shape = space.shape
        is_image = len(shape) > 2
        needless = (
            f"shows {_in_words(space)}, and channels={channels!r} is for images of 3 or 4 dimensions: leave it out"
        )
        require((is_image or channels is None, needless))
        self.dtype = np.uint8 if space.dtype == np.uint8 else np.float32
        if len(shape) == 1:
            self.shape = shape
        elif len(shape) == 2:
            self.shape = (1, *shape)
        else:
            place = channels or _place_of_channels(space)
            frames = tuple(range(len(shape) - 3))
            last = len(shape) - 1
            pixels = (last - 2, last - 1) if place == "last" else (last - 1, last)
            channel = last if place == "last" else last - 2
            self.axes = (*frames, channel, *pixels)
            sizes = [shape[axis] for axis in self.axes]
            self.shape = (math.prod(sizes[:-2]), *sizes[-2:])

    def read(self, observation: Any) -> NDArray[Any]:
        """Return an observation in its shown form.

        Raises:
            ValueError: for what the space does not hold.
            FloatingPointError: for numbers that are not finite.
        """
        if self.is_integer:
            number = read_number(observation, "the observation")
            place = number - int(self.space.start)
            inside = place in range(self.shape[0])
            require((inside, f"the observation {observation!r:.80} is not in its space {self.space}"))
            shown = np.zeros(self.shape, dtype=np.uint8)
            shown[int(place)] = 1
            return shown
        array = _as_array(observation)
        require((array.dtype.kind in "biuf", f"the observation must be numbers, got {observation!r:.80}"))
        shape = self.space.shape
        alike = [size for size in array.shape if size != 1] == [size for size in shape if size != 1]
        require((alike, f"the observation has the shape {array.shape}, and its space {shape}"))
        array = array.reshape(shape)
        wrong = ~(np.abs(array).astype(np.float64) <= LARGEST)  # LARGEST is infinite as float16
        if array.dtype.kind == "f" and wrong.any():
            [first] = np.argwhere(wrong)[:1].tolist()
            value = array[tuple(first)]
            raise FloatingPointError(f"the observation is {value} at {first}, which is not finite as float32")
        if self.dtype == np.uint8 and array.dtype != np.uint8:
            with np.errstate(invalid="ignore"):
                pixels = array.astype(np.uint8)
            changed = array[pixels != array].flat[:1].tolist()
            require((not changed, f"the observation has the value {changed}, and its space is uint8: cast it"))
            array = pixels
        if self.axes is not None:
            array = array.transpose(self.axes)
        return array.reshape(self.shape).astype(self.dtype)

    def read_first(self, returned: Any) -> NDArray[Any]:
        """Return the observation of what ``reset`` returned."""
        fits = isinstance(returned, (tuple, list)) and len(returned) == 2
        require((fits, f"reset must return observation and info, got {returned!r:.80}"))
        return self.read(returned[0])

    def read_step(self, returned: Any) -> Taken:
        """Return what ``step`` returned."""
        fits = isinstance(returned, (tuple, list)) and len(returned) == 5
        require((fits, f"step must return observation, reward, terminated, truncated and info, got {returned!r:.80}"))
        observation, reward, terminated, truncated, _ = returned
        return Taken(
            self.read(observation),
            read_number(reward, "the reward"),
            _read_flag(terminated, "terminated"),
            _read_flag(truncated, "truncated"),
        )


class ActionForm:
    """How the actions of a space are given: integers from 0, int64, or the numbers of a ``Box``, float32.

    Raises:
        ValueError: for other spaces.
    """

    def __init__(self, space: Any) -> None:
        self.space = space
        known = is_discrete(space) or is_box(space)
        fix = "add a wrapper of your own that is a gymnasium.ActionWrapper with Discrete or Box actions"
        require((known, f"takes {space!s:.200}: actions must be integers or a Box: {fix}"))
        self.num_actions = int(space.n) if is_discrete(space) else None
        self.shape: tuple[int, ...] = () if self.num_actions is not None else space.shape

    @property
    def form(self) -> str:
        """The form in words; equal forms take the same actions."""
        return str(self.space) if self.num_actions is None else f"Discrete({self.num_actions})"

    def read(self, actions: NDArray[Any]) -> NDArray[Any]:
        """Return a copy of the rows' actions, [rows, *shape].

        Raises:
            ValueError: for actions of another shape, and integers that are no action.
        """
        rows = len(actions)
        fits = actions.size == rows * math.prod(self.shape)
        require((fits, f"actions must have the shape {[rows, *self.shape]}, got {list(actions.shape)}"))
        actions = actions.reshape(rows, *self.shape).copy()
        if self.num_actions is not None:
            outside = (actions < 0) | (actions >= self.num_actions)
            last = self.num_actions - 1
            require(
                (actions.dtype.kind in "iu", f"actions must be integers, got {actions.dtype}"),
                (not outside.any(), f"actions must be in 0..{last}, got {actions[outside][:5].tolist()}"),
            )
        return actions

    def give(self, action: Any) -> Any:
        """Return a copy of a row's action in the space's own numbers."""
        if self.num_actions is not None:
            return self.space.dtype.type(int(action) + int(self.space.start))
        dtype = self.space.dtype
        if dtype.kind in "iub":
            return np.rint(action).astype(dtype)
        given = np.array(action, dtype=dtype)
        if dtype == np.float64:  # float32 rounds ends to values beyond the space
            for end, rounded in zip((self.space.low, self.space.high), self.ends, strict=True):
                given = np.where(given == rounded, end, given)
        return given

    @property
    def ends(self) -> NDArray[np.float32]:
        """Lowest and highest action of a ``Box``, [2, *shape]."""
        with np.errstate(over="ignore"):
            return np.stack([self.space.low, self.space.high]).astype(np.float32)


def read_number(value: Any, what: str) -> float:
    """Return a number of Python, NumPy or torch as a float.

    Raises:
        ValueError: for anything else.
        FloatingPointError: for one that is not finite as float32.
    """
    number = _only_item(value)
    require((isinstance(number, (bool, int, float)), f"{what} must be one number, got {value!r:.80}"))
    if not abs(number) <= LARGEST:
        raise FloatingPointError(f"{what} is {number!s:.40}, which is not finite as float32")
    return float(number)


def _read_flag(value: Any, what: str) -> bool:
    flag = _only_item(value)
    require((flag is None or isinstance(flag, (bool, int, float)), f"{what} must be true or false, got {value!r:.80}"))
    return bool(flag)


def _only_item(value: Any) -> Any:
    value = plain(value)
    while isinstance(value, (list, tuple)) and len(value) == 1:
        value = value[0]
    return value


def _as_array(value: Any) -> NDArray[Any]:
    try:
        array = np.asarray(value)
    except (RuntimeError, TypeError, ValueError):  # such as a tensor of a GPU, or one with a gradient
        array = np.asarray(None)
    if array.dtype.kind != "O":
        return array
    try:
        return np.asarray(plain(value))
    except (TypeError, ValueError):
        return np.asarray(None)


def _place_of_channels(space: Any) -> str:
    shape = space.shape
    first = shape[-3] in CHANNELS
    last = shape[-1] in CHANNELS
    known = first != last
    if len(shape) == 4:
        pixels = shape[2:] if first else shape[1:3]
        known = known and shape[0] < min(pixels)
    fix = "give GymTask(channels='first') or GymTask(channels='last')"
    require((known, f"shows {_in_words(space)}, and which axis of an image is the channels is not clear: {fix}"))
    return "first" if first else "last"


def _in_words(space: Any) -> str:
    return f"{space.dtype} {list(space.shape)}" if is_box(space) else f"{space!s:.200}"
