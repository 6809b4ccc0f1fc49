"""Checkpoints that can be trusted: whole files with a checksum, the last two kept, read without running any code.

A file is one line of JSON, ``{"format": 1, "frames": ..., "bytes": ..., "sha256": ...}``, and `torch.save` of plain
tensors and Python values. Length and checksum must agree, and ``weights_only=True`` refuses anything else.
"""

from __future__ import annotations

import io
import json
import pickle
import shutil
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from ctgraph_rl.checks import as_path, is_int, not_negative, require, true_or_false
from ctgraph_rl.disk import PART, make_folder, require_no_link, sync_folder, write_whole
from ctgraph_rl.log.saved import read_content, read_plain
from ctgraph_rl.log.sums import sum_of
from ctgraph_rl.runs.interrupt import Interrupt

FORMAT = 1

KEPT = 2

SECONDS = 300.0

RunState = Mapping[str, Any]
"""Tensors and plain Python values, nested; ``frames`` is the run's frames so far."""


NOT_PLAIN = "a run can only be saved where the agent's state_dict() holds tensors and plain Python values"


class BrokenCheckpoint(ValueError):
    """A checkpoint that is not what was written."""


class Checkpoints:
    """The checkpoints of one run in a folder, made with the first.

    Args:
        seconds: time between two checkpoints within a block, >= 0.
        strict: refuse, instead of warn, to resume from an older checkpoint if the newest is broken.
        interrupt: when the process is asked to stop, a checkpoint is saved and it exits.

    Raises:
        ValueError: for values out of range.
    """

    def __init__(
        self, folder: Path | str, seconds: float = SECONDS, strict: bool = False, interrupt: Interrupt | None = None
    ) -> None:
        require(*not_negative(seconds=seconds), *true_or_false(strict=strict))
        self.folder = as_path("folder", folder)
        self.seconds = seconds
        self.strict = strict
        self.interrupt = Interrupt() if interrupt is None else interrupt
        self._last: float | None = None

    def offer(self, state: Callable[[], RunState], at_block_end: bool) -> None:
        """Save if it is time, called after every update.

        The first one is saved at once, so that a full disk or an unreadable state stops a run early.
        """
        offer_all([self], lambda: [state()], at_block_end)

    def offer_one(self, states: Callable[[], Sequence[RunState]], at_block_end: bool) -> None:
        """`offer` the one state of a list."""
        self.offer(lambda: states()[0], at_block_end)

    def save(self, state: RunState, is_like_others: bool = False) -> None:
        """Write a checkpoint, then remove the oldest, and broken ones later than the run.

        Args:
            is_like_others: whether one of a group was read back before, which has the same parts.

        Raises:
            OSError: if it cannot be written; names the sizes and the checkpoint that is kept.
            ValueError: if the first one cannot be read back, as it holds more than tensors and plain values.
        """
        path = self.path_of(state["frames"])
        content = encoded(state)
        if self._last is None and not is_like_others:
            try:
                read_plain(content.partition(b"\n")[2])
            except ValueError as error:  # it could be written and never read
                raise ValueError(f"{NOT_PLAIN}: {error.__cause__}") from error
        make_folder(self.folder)
        try:
            write_whole(path, content)
        except OSError as error:
            kept = self.files()
            last = f"the checkpoint after {_frames(kept[0]):,} frames is kept" if kept else "there is none before"
            raise OSError(error.errno, f"{error.strerror}; {last}. Make room, then run the same command") from error
        self._last = time.monotonic()
        files = self.files()
        here = files.index(path)
        for other in (*files[:here], *files[here + KEPT :]):
            other.unlink(missing_ok=True)

    def path_of(self, frames: int) -> Path:
        """Return the path of the checkpoint after ``frames``."""
        return self.folder / f"{frames:012d}.pt"

    def files(self) -> list[Path]:
        """Return the checkpoints, newest first.

        Raises:
            ValueError: if a link is in place of their folder.
        """
        require_no_link(self.folder)
        return sorted((file for file in self.folder.glob("*.pt") if file.stem.isdecimal()), key=_frames, reverse=True)

    @property
    def newest_frames(self) -> int | None:
        """Frames of the newest, or None."""
        files = self.files()
        return _frames(files[0]) if files else None

    def newest(self) -> RunState | None:
        """Return the newest sound checkpoint or None; warn of broken ones.

        Raises:
            BrokenCheckpoint: for a broken one, if ``strict``; and if all are broken.
        """
        files = self.files()
        for file in files:
            try:
                return decoded(file)
            except BrokenCheckpoint as error:
                if self.strict or file == files[-1]:
                    raise
                warnings.warn(f"{error}; the one before it is used", stacklevel=2)
        return None

    def clear(self) -> None:
        """Remove all durably."""
        if self.folder.exists():
            shutil.rmtree(self.folder, ignore_errors=True)
            sync_folder(self.folder.parent)

    def tidy(self) -> None:
        """Remove half-written files of a killed process."""
        require_no_link(self.folder)
        for part in self.folder.glob("*" + PART):
            part.unlink(missing_ok=True)


def offer_all(checkpoints: Sequence[Checkpoints], states: Callable[[], Sequence[RunState]], at_block_end: bool) -> None:
    """`Checkpoints.offer` for runs that learn together: all are saved or none."""
    first = checkpoints[0]
    stop = first.interrupt.is_asked
    is_late = first._last is None or time.monotonic() - first._last >= first.seconds
    if stop or at_block_end or is_late:
        for number, (each, state) in enumerate(zip(checkpoints, states(), strict=True)):
            each.save(state, is_like_others=number > 0)
    if stop:
        first.interrupt.exit()


def newest_of_all(checkpoints: Sequence[Checkpoints]) -> list[RunState] | None:
    """Return the newest states of runs that learn together, after equal frames; None if one has no checkpoint.

    Raises:
        BrokenCheckpoint: as `Checkpoints.newest`.
        OSError: if a run lacks a checkpoint after the frames of another's newest.
    """
    found = [each.newest() for each in checkpoints]
    states = [state for state in found if state is not None]
    if len(states) < len(found):
        return None
    frames = min(state["frames"] for state in states)
    pairs = zip(checkpoints, states, strict=True)
    return [state if state["frames"] == frames else decoded(each.path_of(frames)) for each, state in pairs]


def encoded(state: RunState) -> bytes:
    """Return the bytes of a checkpoint.

    Raises:
        ValueError: for what cannot be saved at all.
    """
    buffer = io.BytesIO()
    try:
        torch.save(dict(state), buffer)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ValueError(f"{NOT_PLAIN}: {error}") from error
    content = buffer.getvalue()
    header = {"format": FORMAT, "frames": state["frames"], **sum_of(content)}
    return json.dumps(header).encode() + b"\n" + content


def decoded(path: Path) -> RunState:
    """Read a checkpoint, its tensors on the CPU.

    Raises:
        BrokenCheckpoint: if it is torn, changed, of another format, or not plain.
    """
    advice = "delete it to resume from the one before"
    try:
        head, _, content = read_content(path).partition(b"\n")
    except ValueError as error:
        raise BrokenCheckpoint(f"{error}; {advice}") from None
    try:
        header = json.loads(head)
        version = header["format"]
        expected = {"bytes": header["bytes"], "sha256": header["sha256"]}
    except (ValueError, KeyError, TypeError, RecursionError):
        raise BrokenCheckpoint(f"{path} is no checkpoint, or torn; {advice}") from None
    if version != FORMAT:
        raise BrokenCheckpoint(f"{path} has format {version}, this version reads {FORMAT}; overwrite=true starts again")
    if sum_of(content) != expected:
        size = f"{len(content)} of {expected['bytes']} bytes"
        raise BrokenCheckpoint(f"{path} is not what was written: {size}; {advice}")
    try:
        state = read_plain(content)
    except ValueError as error:
        raise BrokenCheckpoint(f"{path} {error}, and is not read; {advice}") from error
    if not (isinstance(state, dict) and is_int(state.get("frames"), 0)):
        raise BrokenCheckpoint(f"{path} does not say after how many frames it was made; {advice}")
    return state


def _frames(file: Path) -> int:
    return int(file.stem)
