"""An episode as an animated GIF of what `CTGraphEnv.render` draws."""

from __future__ import annotations

import io
from pathlib import Path

import torch

from ctgraph_rl.checks import at_least_one, positive, require
from ctgraph_rl.disk import write_named
from ctgraph_rl.play.player import Player

LAST = 3


def save_gif(player: Player, path: Path | str, seconds: float = 0.6, size: int = 192, most_frames: int = 200) -> None:
    """Let a policy play one episode and write its pictures.

    Args:
        seconds: of a picture.
        size: height in pixels, at least 48.
        most_frames: pictures after which the film ends.

    Raises:
        ModuleNotFoundError: without pillow; names the extra to install.
        ValueError: for values out of range.
    """
    require(*positive(seconds=seconds), *at_least_one(most_frames=most_frames))
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("GIFs need pillow: pip install 'ctgraph_rl[plot]'") from error
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(player.seed)
        player.start()
        frames = [player.env.render(size)[0]]
        over = False
        while not over and len(frames) < most_frames:
            over = player.step()
            frames.append(player.env.render(size)[0])
    first, *others = [Image.fromarray(frame.numpy()) for frame in frames]
    stay = [round(1000 * seconds)] * len(others) + [round(1000 * seconds * LAST)]
    buffer = io.BytesIO()
    first.save(buffer, "GIF", save_all=True, append_images=others, duration=stay, loop=0)
    write_named(path, buffer.getvalue())
