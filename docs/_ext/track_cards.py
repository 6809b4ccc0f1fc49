"""A card for each track of the board: what it measures, what its tasks allow, how to run it, and what is published."""

from __future__ import annotations

from collections.abc import Iterator

from yaml_settings import ALONE, escaped

from ctgraph_rl.board.standings.track_ceilings import ceilings_of, write_ceiling
from ctgraph_rl.board.tracks import HELD_OUT_SEEDS, TUNING_SEEDS, Track, tracks, write_seeds


def track_cards() -> Iterator[tuple[str, str]]:
    """Yield the path and the text of each card, and of the list of them, in Markdown."""
    found = tracks()
    rows = [f"| [`{each.name}`]({each.name}.md) | {each.version} | {escaped(each.measures)} |" for each in found]
    words = (
        "The [rules](../../reference/tracks.md) of tracks, and how to [submit and read results](../../how-to/board.md)."
    )
    yield (
        "tracks/index.md",
        "\n".join(
            ["# Track cards", "", words, "", "| track | version | what it measures |", "|---|--:|---|", *rows, ""]
        ),
    )
    for each in found:
        yield f"tracks/{each.name}.md", _card(each)


def _card(track: Track) -> str:
    names = dict.fromkeys(variant.curriculum.name for variant in track.variants)
    facts = {
        "curriculum": ", ".join(
            f"[`{name}`](../curricula/{name}.md), modified where settings differ" for name in names
        ),
        "score": f"`{track.score}`",
        "seeds of a submission": write_seeds(track.seeds),
        "seeds for tuning": write_seeds(TUNING_SEEDS),
        "seeds that verifiers draw from": f"{HELD_OUT_SEEDS[0]:,} to {HELD_OUT_SEEDS[-1]:,}",
    }
    which = "every rung as the track gives it" if len(track.rungs) > 1 else "the first one"
    parts = [
        ALONE,
        f"# `track={track.name}`",
        "[All tracks](index.md)",
        f"{escaped(track.measures)}",
        f"**Breakthrough.** {escaped(track.breakthrough)}",
        "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in facts.items())]),
        f"```bash\nctgraph-rl -m track={track.name} agent=lstm_ppo\n```",
        "## What may be submitted, and what its tasks allow",
        "Mean returns over the tasks, in closed form. Each row is a table of its own on a board. The line above runs "
        f"{which}; others need their settings, too.",
        _table(track),
    ]
    return "\n\n".join(parts) + "\n"


def _table(track: Track) -> str:
    """Return the variants of a track with what their tasks allow."""
    found = [(variant, ceilings_of(variant.curriculum)) for variant in track.variants]
    shown = [name for name in found[0][1] if any(ceilings[name] is not None for _, ceilings in found)]
    rung = ["rung"] * (len(track.rungs) > 1)
    rows = [[*rung, "given", "settings", "steps", *shown]]
    rows.append(["---"] * len(rows[0]))
    for variant, ceilings in found:
        settings = " ".join(f"`{setting}`" for setting in variant.settings)
        values = ["" if ceilings[name] is None else write_ceiling(ceilings[name]) for name in shown]
        own = [variant.rung] * len(rung)
        rows.append([*own, variant.given, settings, f"{variant.curriculum.num_frames:,}", *values])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in rows)
