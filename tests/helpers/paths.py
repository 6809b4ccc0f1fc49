"""Folders that tests read from."""

import subprocess
from collections.abc import Sequence
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
CHECKOUT = TESTS.parent
DATA = TESTS / "data"


def sources(kinds: Sequence[str]) -> list[Path]:
    """Return files of the checkout by suffix, without what builds and caches leave; in an archive without git, too."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"], cwd=CHECKOUT, capture_output=True, text=True
    )
    paths = [CHECKOUT / line for line in listed.stdout.splitlines()] or sorted(CHECKOUT.rglob("*"))
    return [path for path in paths if path.suffix in kinds and path.is_file() and not _is_made(path)]


def _is_made(path: Path) -> bool:
    parts = path.relative_to(CHECKOUT).parts
    made = any(part.startswith(".") or part in ("generated", "_build") for part in parts[:-1])
    return made or parts[0] in ("build", "dist", "runs")
