"""Draws the figures of the cards, in parallel, and only those whose curriculum or drawing code has changed."""

from __future__ import annotations

import hashlib
import os
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path

import torch

import curricula
from ctgraph_rl.tasks.task import are_graphs
from ctgraph_rl.visualize import curriculum_figure
from ctgraph_rl.visualize.curriculum_figure import draw_graphs
from ctgraph_rl.visualize.similarity_figure import draw_similarity

DRAWINGS = {"graphs": draw_graphs, "similarity": draw_similarity}


def draw_all(folder: Path) -> dict[str, tuple[str, str]]:
    """Draw graphs and similarity of curricula of CT-graphs; return the names of the two files by curriculum."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [name for name in curricula.names() if are_graphs(curricula.load(name).tasks)]
    files = {name: tuple(_file(name, kind) for kind in DRAWINGS) for name in names}
    missing = [
        (folder / file, name, kind) for name, pair in files.items() for file, kind in zip(pair, DRAWINGS, strict=True)
    ]
    missing = [each for each in missing if not each[0].is_file()]
    with ProcessPoolExecutor(os.cpu_count(), initializer=torch.set_num_threads, initargs=(1,)) as pool:
        list(pool.map(_draw, missing, chunksize=4))
    wanted = {file for pair in files.values() for file in pair}
    for path in folder.glob("*-*.png"):
        if path.name not in wanted:
            path.unlink()
    return files


def _file(name: str, kind: str) -> str:
    digest = hashlib.sha256(f"{curricula.load(name).fingerprint} {_code()}".encode()).hexdigest()
    return f"{name}-{kind}-{digest[:8]}.png"


@cache
def _code() -> str:
    """Return a digest of the code that draws."""
    paths = sorted(Path(curriculum_figure.__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()


def _draw(job: tuple[Path, str, str]) -> None:
    path, name, kind = job
    DRAWINGS[kind](curricula.load(name), path)
