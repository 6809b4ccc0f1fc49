"""``ctgraph-rl methods``: the methods, what each needs to know, and the detectors that find it out."""

from __future__ import annotations

import argparse

from baselines.parts.catalogue import CatalogueEntry, catalogue


def needs_ids(method: CatalogueEntry) -> str:
    """Return when a method needs task ids: ``yes``, ``no`` or with which setting."""
    return "yes" if method.facts["needs_task_id"] else "heads=multi" if "heads" in method.settings else "no"


def main() -> None:
    """Print a line for every method, and for every detector that gives methods the ids and boundaries they need."""
    argparse.ArgumentParser(prog="ctgraph-rl methods", description=main.__doc__).parse_args()
    print("method=NAME  needs ids    boundaries  what it is")
    for method in catalogue("method"):
        boundaries = "yes" if method.facts["needs_boundaries"] else "no"
        print(f"{method.name:<12} {needs_ids(method):<12} {boundaries:<11} {method.comment}")
    print("\ndetector=NAME  reads                 what it is")
    for detector in catalogue("detector"):
        print(f"{detector.name:<14} {detector.facts['reads']:<21} {detector.comment}")


if __name__ == "__main__":
    main()
