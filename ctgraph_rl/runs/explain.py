"""Messages for errors of Hydra and OmegaConf: the cause, and the likely name."""

from __future__ import annotations

import re
import sys
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.errors import MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from ctgraph_rl.checks import NamedValues, did_you_mean, nearest
from ctgraph_rl.packages import conf_dir
from ctgraph_rl.runs.settings import as_typed, flat

SAID = (
    (re.compile(r"Ambiguous value for argument '\+?seeds=(.*)'"), "seeds={0} is no setting: give -m seed={0}"),
    (
        re.compile(r"Ambiguous value for argument '(.*)'"),
        "{0} has several values: add -m to run each; a list is written in brackets, a text in quotes",
    ),
    (re.compile(r"Sweep parameters '(\S+?)=.*' requires --multirun"), "{0} has several values: add -m to run each"),
    (
        re.compile(r"(?:In '\S+': )?You must specify '(\S+)', e"),
        "{0}=??? names no file: name one, such as {0}=NAME, or leave {0} out",
    ),
    (
        re.compile(r"Config group override deletion value must be a string.*input_line='(.+?)'", re.DOTALL),
        "{0} removes a group by a value that no file of it has: leave {0} out",
    ),
    (
        re.compile(r"Could not delete from config\. The value of '(\S+)' is (.+) and not (.+)\.", re.DOTALL),
        "~{0}={2} removes {0} only where it is {2}, and it is {1}: leave ~{0}={2} out",
    ),
    (re.compile(r"Could not delete from config\. '(\S+)' does"), "~{0} removes what has no value: leave ~{0} out"),
    (
        re.compile(r"\[Errno 17\] File exists: '(.*)'"),
        "{0} is a file, and a run needs a folder: give another hydra.run.dir",
    ),
    (re.compile(r"Multiple values for (\S+)\. To override .*'override \S+: (.*)'"), "{0} has a value: write {0}={1}"),
)

MOST_CHOICES = 20

LAUNCHERS = {"hydra/launcher/joblib": "joblib", "hydra/launcher/submitit_slurm": "slurm"}

_NO_SETTINGS = {"_target_", "hydra"}


def find_cause(error: BaseException) -> BaseException:
    """Return the first error within Hydra's that says what to do, or the innermost."""
    told = (ValueError, OSError, ModuleNotFoundError)  # which say what to do, unless they are of OmegaConf
    while error.__cause__ is not None and (isinstance(error, OmegaConfBaseException) or not isinstance(error, told)):
        error = error.__cause__
    return error


def explain(error: BaseException, cfg: DictConfig | None = None) -> str:
    """Return one message for a user's error: its cause within Hydra's errors, and the likely name."""
    cause = find_cause(error)
    if isinstance(cause, OmegaConfBaseException):
        return _of_omegaconf(_first(cause), str(error).strip())
    if cfg is not None and isinstance(cause, ValueError):
        typed = (setting.partition("=")[0].lstrip("+~") for setting in HydraConfig.get().overrides.task)
        return as_typed(str(cause).strip(), _unresolved(cfg), typed)
    if isinstance(cause, MissingConfigException) and cause.missing_cfg_file:
        group, _, name = cause.missing_cfg_file.rpartition("/")
        choices = cause.options or ()
        extra = LAUNCHERS.get(f"{group}/{name}")
        if extra is not None:
            return f"this launcher is another package: pip install 'ctgraph_rl[{extra}]'"
        is_long = len(choices) > MOST_CHOICES and nearest(name, choices) is None
        listed = "ctgraph-rl curricula lists those with names, and axes and graph make others"
        hint = listed if is_long else did_you_mean(name, choices)
        return f"unknown {group or 'configuration'} {name!r}: {hint}"
    if isinstance(cause, OverrideParseException):
        is_value = "=" in str(cause.override)
        how = "quote a value with brackets, commas or spaces" if is_value else "settings are written as in seed=1"
        return f"cannot read {cause.override!r}: {how}"
    message = str(cause).strip()
    chosen = re.match(r"Error resolving interpolation '(.*)', possible", message)
    if chosen is not None:
        return _unresolved_choice(chosen[1])
    return next((text.format(*found.groups()) for rule, text in SAID if (found := rule.match(message))), message)


def _first(error: OmegaConfBaseException) -> OmegaConfBaseException:
    first = error
    each: BaseException | None = error
    while isinstance(each, OmegaConfBaseException):
        first = each if each.full_key else first
        each = each.__context__
    return first


def _of_omegaconf(error: OmegaConfBaseException, message: str) -> str:
    key = str(error.full_key or "")
    if not isinstance(error.parent_node, DictConfig) or not key:
        return message
    group, _, name = key.rpartition(".")
    root = error.parent_node._get_root()
    holder = OmegaConf.select(root, group) if group else root
    if not isinstance(holder, DictConfig) or name not in set(holder):  # ``in`` of OmegaConf denies what has no value
        return _unknown_setting(key, error.parent_node)
    if isinstance(error, MissingMandatoryValue):
        return f"{key}=??? has no value: ??? stands for one that must be given; give it, or leave {key} out"
    raw = holder._get_node(name)._value()  # type: ignore[union-attr]
    return f"{key}={raw}: {_why_unresolved(str(error), str(raw))}"


def _unresolved_choice(raw: str) -> str:
    setting = next((word for word in sys.argv if word.endswith(f"={raw}")), raw)
    try:
        OmegaConf.to_container(OmegaConf.create({"choice": raw}), resolve=True)
    except OmegaConfBaseException as error:
        return f"{setting}: {_why_unresolved(str(error), raw)}"
    return f"{setting}: a group is chosen by the name of a file; write the name itself"


def _why_unresolved(message: str, raw: str) -> str:
    why = message.partition("\n")[0].rpartition("raised while resolving interpolation: ")[2].strip('"')
    why = why.replace("Unsupported interpolation type", "there is no resolver")
    if "nvironment variable" in why:
        return f"{why}; set it, or write what it is where it is not set, {raw.replace('}', ',VALUE}', 1)}"
    return f"{why}; write the value itself"


def _unknown_setting(asked: str, node: DictConfig) -> str:
    group, _, key = asked.rpartition(".")
    if group == "hydra.runtime.choices" and len(node):
        return _removed(key)
    beside = [f"{group}.{name}".lstrip(".") for name in map(str, node) if name not in _NO_SETTINGS]
    groups = [] if group else [path.name for path in Path(conf_dir()).iterdir() if path.is_dir()]
    below = [] if group else [name for name, _ in flat(_unresolved(node))]
    if not group and key in (*groups, *OmegaConf.load(Path(conf_dir(), "config.yaml"))):
        return _removed(key)
    ends = {name.rpartition(".")[2]: name for name in (*reversed(below), *groups, *beside)}  # the last one counts
    near = nearest(key, set(ends) - _NO_SETTINGS)
    hint = f"choices: {', '.join(beside) or 'none'}" if near is None else f"did you mean {ends[near]!r}?"
    return f"unknown setting {asked!r}: {hint}"


def _removed(key: str) -> str:
    return f"~{key} removes {key}, which every run needs: leave ~{key} out"


def _unresolved(cfg: DictConfig) -> NamedValues:
    values: NamedValues = OmegaConf.to_container(cfg, resolve=False)  # type: ignore[assignment]
    values.pop("hydra", None)
    return values
