"""``python -m curricula`` lists all curricula, ``python -m curricula describe NAME`` describes one."""

from __future__ import annotations

from ctgraph_rl import describe
from curricula import load, names


def main(prog: str | None = None) -> None:
    """See `ctgraph_rl.describe.main`."""
    describe.main(names, load, prog)


if __name__ == "__main__":
    main("python -m curricula")
