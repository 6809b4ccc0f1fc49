"""``ctgraph-rl methods``: the methods, what each needs to know, the detectors that find it, and plasticities."""

from __future__ import annotations

from baselines.parts.catalogue import CatalogueEntry, catalogue, config_dir_of


def needs_ids(method: CatalogueEntry) -> str:
    """Return when a method needs task ids: ``yes``, ``no``, with which setting, or ``-`` of yours."""
    needs = method.says("needs_task_id")
    return "heads=multi" if needs == "no" and "heads" in method.settings else needs


def main() -> None:
    """Print a line for every method, every detector that gives methods the ids and boundaries they need, and every
    plasticity.
    """
    config_dir = config_dir_of("methods", main.__doc__)
    print("method=NAME  needs ids    boundaries  what it is")
    for method in catalogue("method", config_dir):
        print(f"{method.name:<12} {needs_ids(method):<12} {method.says('needs_boundaries'):<11} {method.comment}")
    print("\nplasticity=NAME     what it is")
    for plasticity in catalogue("plasticity", config_dir):
        print(f"{plasticity.name:<19} {plasticity.comment}")
    print("\ndetector=NAME  reads                 what it is")
    for detector in catalogue("detector", config_dir):
        print(f"{detector.name:<14} {detector.facts.get('reads', '-'):<21} {detector.comment}")


if __name__ == "__main__":
    main()
