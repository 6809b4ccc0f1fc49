"""Draws the figures of the cards, in parallel, and only those whose curriculum or drawing code has changed."""

from __future__ import annotations

import hashlib
import os
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path

import torch
from short_runs import NAME, draw_curves, lines_of
from studies.raw import HERE

import curricula
from ctgraph_rl.draw import curriculum_figure
from ctgraph_rl.draw.curriculum_figure import draw_graphs
from ctgraph_rl.draw.similarity_figure import draw_similarity
from ctgraph_rl.tasks.task import are_graphs

DRAWINGS = {"graphs": draw_graphs, "similarity": draw_similarity, "curves": draw_curves}


def draw_all(folder: Path) -> dict[str, dict[str, str]]:
    """Draw what is known of each curriculum; return the names of the files by curriculum and kind of drawing."""
    folder.mkdir(parents=True, exist_ok=True)
    files = {name: {kind: _file(name, kind) for kind in _kinds(name)} for name in curricula.names()}
    missing = [(folder / file, name, kind) for name, of in files.items() for kind, file in of.items()]
    missing = [each for each in missing if not each[0].is_file()]
    with ProcessPoolExecutor(os.cpu_count(), initializer=torch.set_num_threads, initargs=(1,)) as pool:
        list(pool.map(_draw, missing, chunksize=4))
    wanted = {file for of in files.values() for file in of.values()}
    for path in folder.glob("*-*.png"):
        if path.name not in wanted:
            path.unlink()
    return files


def _kinds(name: str) -> list[str]:
    """Return what is drawn: graphs and their similarity of CT-graphs, curves where there are short runs."""
    kinds = ["graphs", "similarity"] if are_graphs(curricula.load(name).tasks) else []
    return [*kinds, "curves"] if lines_of(name) else kinds


def _file(name: str, kind: str) -> str:
    digest = hashlib.sha256(f"{curricula.load(name).fingerprint} {_code(kind)}".encode()).hexdigest()
    return f"{name}-{kind}-{digest[:8]}.png"


@cache
def _code(kind: str) -> str:
    """Return a digest of what draws: the code, and the raw results of short runs."""
    paths = [Path(__file__).with_name("short_runs.py"), HERE / f"{NAME}.csv"]
    if kind != "curves":
        paths = sorted(Path(curriculum_figure.__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()


def _draw(job: tuple[Path, str, str]) -> None:
    path, name, kind = job
    DRAWINGS[kind](curricula.load(name), path)
