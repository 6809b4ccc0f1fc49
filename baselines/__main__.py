"""``ctgraph-rl agents``: the agents, which tasks each can solve in principle, and what their memories can hold."""

from __future__ import annotations

import argparse

from baselines.parts.catalogue import catalogue

NOTE = (
    "cell= is what an agent with memory remembers with. Without memory, or with cell=none, an agent acts on the\n"
    "present observation only: where that does not show the state, its return is at most the memoryless ceiling of\n"
    "the task, which ctgraph-rl curricula describe NAME shows."
)
"""What an agent without memory loses."""


def main() -> None:
    """Print a line for every agent, and for every cell that agents with memory can have."""
    argparse.ArgumentParser(prog="ctgraph-rl agents", description=main.__doc__).parse_args()
    print("agent=NAME   memory  can solve in principle")
    for agent in catalogue("agent"):
        print(f"{agent.name:<12} {'yes' if agent.facts['memory'] else 'no':<7} {agent.facts['solves']}")
    print("\ncell=NAME      can hold")
    for cell in catalogue("cell"):
        print(f"{cell.name:<14} {cell.facts['holds']}")
    print(f"\n{NOTE}")


if __name__ == "__main__":
    main()
