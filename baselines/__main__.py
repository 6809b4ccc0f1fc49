"""``python -m baselines``: the agents, and which tasks each can solve in principle."""

from __future__ import annotations

import argparse

from baselines.catalogue import catalogue


def main() -> None:
    """Print a line for every agent."""
    argparse.ArgumentParser(prog="ctgraph-rl agents", description=main.__doc__).parse_args()
    print("agent=NAME   memory  can solve in principle")
    for name, kind, *_ in catalogue("agent"):
        print(f"{name:<12} {'yes' if kind.memory else 'no':<7} {kind.solves}")


if __name__ == "__main__":
    main()
