"""RL^2 on a goal that is swapped once, unannounced: `penn_a_swap`."""

from __future__ import annotations

from studies.raw import Raw, groups, read

NAME = "rl2_swap"

LEARNED = 0.9
"""The least greedy return of a goal that is learned."""


def runs() -> dict[tuple[str, ...], Raw]:
    """Return the lines of each seed."""
    return groups(read(NAME), "seed")


def frames_to_learn(lines: Raw) -> int | None:
    """Return the frames from the swap to the first evaluation with the new goal learned; None: there is none."""
    swap = max(int(line["frames"]) for line in lines if line["block"] == "1")
    new = [line for line in lines if (line["block"], line["task"]) == ("2", "2")]
    found = [int(line["frames"]) - swap for line in new if float(line["greedy_return"]) >= LEARNED]
    return found[0] if found else None


def texts() -> dict[str, str]:
    """Return what the template of the page names."""
    of = list(runs().values())
    times = [frames_to_learn(lines) for lines in of]
    found = [time for time in times if time is not None]
    return {
        "swapped": f"{len(found)} of {len(of)}",
        "swap_frames": f"{min(found):,} to {max(found):,}",
    }
