"""``ctgraph-rl agents``: the agents, the tasks that each can solve in principle, and what their memories can hold."""

from __future__ import annotations

from baselines.parts.catalogue import catalogue, config_dir_of

NOTE = (
    "cell= is what an agent with memory remembers with. Without memory, or with cell=none, an agent acts on the\n"
    "present observation only: where that does not show the state, its return is at most the memoryless ceiling of\n"
    "the task, which ctgraph-rl curricula describe NAME shows."
)
"""What an agent without memory loses."""


def main() -> None:
    """Print a line for every agent, and for every cell that agents with memory can have."""
    config_dir = config_dir_of("agents", main.__doc__)
    print("agent=NAME   memory  can solve in principle")
    for agent in catalogue("agent", config_dir):
        print(f"{agent.name:<12} {agent.says('memory'):<7} {agent.facts.get('solves', agent.comment)}")
    print("\ncell=NAME      can hold")
    for cell in catalogue("cell", config_dir):
        print(f"{cell.name:<14} {cell.facts.get('holds', cell.comment)}")
    print(f"\n{NOTE}")


if __name__ == "__main__":
    main()
