"""Checkpoints that can be trusted: whole files with a checksum, the last two kept, read without running any code.

A file is one line of JSON, ``{"format": 1, "frames": ..., "bytes": ..., "sha256": ...}``, and what `torch.save` makes
of plain tensors and Python values. It is read only if length and checksum agree, and by ``weights_only=True``, which
refuses anything else.
"""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import shutil
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from ctgraph_rl.files import PART, write_whole

if TYPE_CHECKING:
    from ctgraph_rl.interrupt import Interrupt

FORMAT = 1
"""Raised when a checkpoint means something else than before."""

KEPT = 2
"""Checkpoints that are kept, the newest."""

State = Mapping[str, Any]
"""What is saved: tensors and plain Python values, nested; ``frames`` is the number of frames of the run so far."""


class BrokenCheckpoint(ValueError):
    """A checkpoint that is not what was written."""


class Checkpoints:
    """The checkpoints of one run in a folder, which is made with the first one.

    Args:
        folder: where they are.
        seconds: time between two checkpoints within a block.
        strict: refuse to go on from an older checkpoint where the newest is broken, instead of warning.
        interrupt: tells that the process was asked to stop: a checkpoint is then saved, and the process exits.
    """

    def __init__(
        self, folder: Path | str, seconds: float = 300.0, strict: bool = False, interrupt: Interrupt | None = None
    ) -> None:
        self.folder, self.seconds, self.strict, self.interrupt = Path(folder), seconds, strict, interrupt
        self._last = time.monotonic()

    def offer(self, state: Callable[[], State], at_block_end: bool) -> None:
        """Save if it is time, called after every update.

        Args:
            state: makes what is saved.
            at_block_end: always save.
        """
        stop = self.interrupt is not None and self.interrupt.is_asked
        if stop or at_block_end or time.monotonic() - self._last >= self.seconds:
            self.save(state())
        if stop:
            self.interrupt.exit()  # type: ignore[union-attr]

    def save(self, state: State) -> None:
        """Write a checkpoint, then remove the oldest.

        Raises:
            OSError: if it cannot be written; names the sizes and the checkpoint that is kept.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        try:
            write_whole(self.folder / f"{state['frames']:012d}.pt", encoded(state))
        except OSError as error:
            kept = self.files()
            last = f"the checkpoint after {_frames(kept[0]):,} frames is kept" if kept else "there is none before"
            raise OSError(error.errno, f"{error.strerror}; {last}. Make room, then run the same command") from error
        self._last = time.monotonic()
        for old in self.files()[KEPT:]:
            old.unlink(missing_ok=True)

    def files(self) -> list[Path]:
        """The checkpoints, newest first."""
        return sorted(self.folder.glob("*.pt"), reverse=True)

    def newest(self) -> State | None:
        """The newest sound checkpoint, None without one; a broken one is warned of and left out.

        Raises:
            BrokenCheckpoint: for a broken one, if ``strict``; and if there are some, but all are broken.
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
        """Remove all."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def tidy(self) -> None:
        """Remove what was being written when a process was killed."""
        for part in self.folder.glob("*" + PART):
            part.unlink(missing_ok=True)


def encoded(state: State) -> bytes:
    """The bytes of a checkpoint."""
    buffer = io.BytesIO()
    torch.save(dict(state), buffer)
    content = buffer.getvalue()
    header = {"format": FORMAT, "frames": state["frames"], "bytes": len(content), "sha256": _digest(content)}
    return json.dumps(header).encode() + b"\n" + content


def decoded(path: Path) -> State:
    """Read a checkpoint.

    Raises:
        BrokenCheckpoint: if it is torn, changed, of another format, or holds more than tensors and plain values.
    """
    head, _, content = path.read_bytes().partition(b"\n")
    advice = "delete it to go on from the one before"
    try:
        header = json.loads(head)
        version, expected = header["format"], (header["bytes"], header["sha256"])
    except (ValueError, KeyError, TypeError):
        raise BrokenCheckpoint(f"{path} is no checkpoint, or torn; {advice}") from None
    if version != FORMAT:
        raise BrokenCheckpoint(f"{path} has format {version}, this version reads {FORMAT}; overwrite=true starts anew")
    if (len(content), _digest(content)) != expected:
        raise BrokenCheckpoint(f"{path} is not what was written: {len(content)} of {expected[0]} bytes; {advice}")
    try:
        return torch.load(io.BytesIO(content), weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError) as error:
        message = f"{path} holds more than tensors and plain values, and is not read; {advice}"
        raise BrokenCheckpoint(message) from error


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _frames(file: Path) -> int:
    return int(file.stem)
