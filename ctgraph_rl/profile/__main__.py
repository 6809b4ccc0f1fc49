"""The command ``ctgraph-rl profile``: train an agent on ten small curricula, one a learning property, and score it."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

from ctgraph_rl import parsers, run
from ctgraph_rl.checks import require
from ctgraph_rl.log.escape import refused_by, terminal_lines, terminal_text
from ctgraph_rl.packages import import_agents
from ctgraph_rl.profile.profile_page import text_table, write_profile
from ctgraph_rl.report.style import require_packages
from ctgraph_rl.report.terminal import print_note, print_problems
from ctgraph_rl.runs.read import find_runs

FOLDER = "hydra.sweep.dir"


def main() -> None:
    """Train if there are settings, and print the profile; the exit code is 1 if runs are unfinished or left out."""
    parser = parsers.profile()
    arguments = parser.parse_args()
    settings = [word for word in arguments.words if "=" in word]
    folders = [word for word in arguments.words if "=" not in word]
    complete = True
    with refused_by(parser):
        require_packages()
    if settings:
        given = {"curriculum": "glob(profile_*)", FOLDER: "runs/profile"}
        if find_spec("joblib"):
            given["hydra/launcher"] = "joblib"
        given.update(word.split("=", 1) for word in settings)
        folders.append(given[FOLDER])
        learned = given["curriculum"]
        with refused_by(parser):
            require(("profile" in learned, f"a profile learns curricula profile_*, got curriculum={learned}"))
        complete = _train(given, arguments.config_dir)
    out = arguments.out or Path(folders[0], "profile")
    with refused_by(parser):
        if arguments.config_dir is not None:
            for problem in import_agents(arguments.config_dir):
                print_note("left out", problem)
        runs, problems = find_runs(folders)
        scores = write_profile(runs, problems, out, arguments.agent)
    complete = not print_problems(problems, runs) and complete
    print(terminal_lines(text_table(scores)))
    print(f"profile: {terminal_text(out / 'profile.md')}")
    sys.exit(0 if complete else 1)


def _train(settings: dict[str, str], config_dir: Path | None) -> bool:
    sys.argv = ["ctgraph-rl", "-m", *(f"{key}={value}" for key, value in settings.items())]
    if config_dir is not None:
        sys.argv.append(f"--config-dir={config_dir}")
    try:
        run.main()
    except SystemExit as end:
        if end.__context__ is not None or end.code != 1:  # an error, or a signal, and not a sweep with gaps
            raise
        return False
    return True


if __name__ == "__main__":
    main()
