"""Places of `curricula`, `baselines` and ``conf``, and imports by name."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from operator import attrgetter
from pathlib import Path
from typing import Any

from ctgraph_rl.checks import require

HERE = Path(__file__).resolve().parent

OF_REPORT = ("matplotlib", "jinja2", "scipy")


def makes_page(command: str) -> str:
    """Return the command for a page, and what to install for it."""
    first = "" if all(map(find_spec, OF_REPORT)) else "; first pip install 'ctgraph_rl[report]'"
    return f"ctgraph-rl {command} makes a page of figures and tables{first}"


def conf_dir() -> str:
    """Return the configuration's folder: in the package if installed from a wheel, else beside it."""
    for candidate in (HERE / "conf", HERE.parent / "conf"):
        if (candidate / "config.yaml").is_file():
            return str(candidate)
    raise FileNotFoundError(f"no conf/config.yaml in {HERE} or {HERE.parent}; reinstall ctgraph_rl")


def check_packages() -> None:
    """Refuse a ``curricula`` or ``baselines`` that is not the one installed with this package.

    Raises:
        ValueError: names a folder or file, usually in the working directory, that shadows one.
    """
    require(*((False, message) for message in _shadows("curricula", "baselines")))


def warn_of_shadows() -> None:
    """Warn of what `check_packages` refuses."""
    for message in _shadows("curricula", "baselines"):
        warnings.warn(message, stacklevel=3)


def _shadows(*names: str) -> Iterator[str]:
    for name in names:
        spec = find_spec(name)
        ours = HERE.parent / name
        origin = None if spec is None or spec.origin is None else Path(spec.origin).resolve()
        found = origin.parent if origin is not None and origin.name == "__init__.py" else origin
        if found != ours:
            kind = "file" if found == origin else "folder"
            yield f"package {name!r} was found in {found} instead of {ours}; rename or move the {kind} found"


def import_agents(config_dir: Path) -> list[str]:
    """Import the modules of a user's agents, so that runs can be loaded; return why some failed."""
    import yaml

    problems = []
    for path in config_dir.glob("agent/**/*.yaml"):
        try:
            target = yaml.safe_load(path.read_text(encoding="utf-8"))["_target_"]
            with importing_from_here():
                import_module(target.rpartition(".")[0])
        except Exception as error:  # of the user's code
            problems.append(f"the agent of {path} cannot be imported: {error}")
    return problems


def load_object(name: str) -> Any:
    """Return the object of a name such as ``module:Class``."""
    module, _, own_name = name.partition(":")
    return attrgetter(own_name)(import_module(module))


@contextmanager
def importing_from_here() -> Iterator[None]:
    """Find modules in the working directory, too."""
    before = list(sys.path)
    sys.path.append(os.getcwd())
    try:
        yield
    finally:
        sys.path[:] = before


def class_named(module: str, name: str) -> type | None:
    """Return a class of a module of `baselines`, or None.

    Raises:
        ValueError: as `check_packages`.
    """
    check_packages()
    if find_spec(module) is None:
        return None
    kind = getattr(import_module(module), name, None)
    return kind if isinstance(kind, type) and kind.__module__ == module else None
