"""An episode as an animated GIF of what `CTGraphEnv.render` draws."""

from __future__ import annotations

import io
from pathlib import Path

import torch

from ctgraph_rl.disk import write_named
from ctgraph_rl.play.player import Player

MILLISECONDS, OF_THE_LAST = 600, 1800
"""Times of pictures."""

MOST_PICTURES = 200


def save_gif(player: Player, path: Path | str) -> None:
    """Let a policy play one episode and write its pictures, at most `MOST_PICTURES`.

    Raises:
        ModuleNotFoundError: without pillow; names the extra to install.
    """
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("GIFs need pillow: pip install 'ctgraph_rl[plot]'") from error
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(player.seed)
        player.start()
        frames = [player.env.render()[0]]
        over = False
        while not over and len(frames) < MOST_PICTURES:
            over = player.step()
            frames.append(player.env.render()[0])
    first, *others = [Image.fromarray(frame.numpy()) for frame in frames]
    stay = [MILLISECONDS] * len(others) + [OF_THE_LAST]
    buffer = io.BytesIO()
    first.save(buffer, "GIF", save_all=True, append_images=others, duration=stay, loop=0)
    write_named(path, buffer.getvalue())
