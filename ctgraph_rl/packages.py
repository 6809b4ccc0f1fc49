"""The packages that this one finds by name alone: `curricula`, `baselines`, and the yaml files in ``conf``."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from ctgraph_rl.checks import require

if TYPE_CHECKING:
    from ctgraph_rl.tasks.curriculum import Curriculum

HERE = Path(__file__).resolve().parent


def conf_dir() -> str:
    """Return the folder with the configuration: in the package when installed from a wheel, beside it in a checkout."""
    for candidate in (HERE / "conf", HERE.parent / "conf"):
        if (candidate / "config.yaml").is_file():
            return str(candidate)
    raise FileNotFoundError(f"no conf/config.yaml in {HERE} or {HERE.parent}; reinstall ctgraph_rl")


def check_packages() -> None:
    """Refuse a ``curricula`` or ``baselines`` that is not the one installed with this package.

    Raises:
        ValueError: if a folder, usually in the working directory, shadows one of them; names it.
    """
    for name in ("curricula", "baselines"):
        spec, ours = find_spec(name), HERE.parent / name
        found = None if spec is None or spec.origin is None else Path(spec.origin).resolve().parent
        message = f"package {name!r} was found in {found} instead of {ours}; rename or move the folder found"
        require((found == ours, message))


def command(module: str) -> Callable[[], None]:
    """Return the ``main`` of a module of this package, of `curricula` or of `baselines`.

    Raises:
        ValueError: see `check_packages`.
    """
    if not module.startswith("ctgraph_rl."):
        check_packages()
    return import_module(module).main


def curriculum_named(name: str) -> Curriculum:
    """Return a published curriculum.

    Raises:
        ValueError: for an unknown name, with the choices; and see `check_packages`.
    """
    check_packages()
    return import_module("curricula").load(name)


def is_published(curriculum: Curriculum) -> bool | None:
    """Return whether a curriculum is the published one of its name; None if no published one has this name."""
    published = import_module("curricula")
    if curriculum.name not in published.names():
        return None
    return published.load(curriculum.name).fingerprint == curriculum.fingerprint


def class_named(module: str, name: str) -> type | None:
    """Return a class that a module of `baselines` defines; None if there is no such module or class."""
    kind = getattr(import_module(module), name, None) if find_spec(module) is not None else None
    return kind if isinstance(kind, type) and kind.__module__ == module else None
