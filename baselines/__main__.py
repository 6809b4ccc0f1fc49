"""``ctgraph-rl agents``: the agents, and which tasks each can solve in principle."""

from __future__ import annotations

import argparse

from baselines.catalogue import catalogue


def main() -> None:
    """Print a line for every agent."""
    argparse.ArgumentParser(prog="ctgraph-rl agents", description=main.__doc__).parse_args()
    print("agent=NAME   memory  can solve in principle")
    for agent in catalogue("agent"):
        print(f"{agent.name:<12} {'yes' if agent.facts['memory'] else 'no':<7} {agent.facts['solves']}")


if __name__ == "__main__":
    main()
