"""Runs and sweeps in the process of a test; the fixture `learned` of conftest.py learns their cells.

Hydra parses each file once in a process, and finds and merges those of equal choices once. A configuration is what the
choices of groups give, with settings on top of it. The first is kept for equal choices of equal files, the second is
done each time. Files of this package and of Hydra stay equal while tests run. What is kept is pickled: OmegaConf takes
six times as long to copy it.
"""

from __future__ import annotations

import copy
import json
import pickle
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository
from hydra._internal.defaults_list import DefaultsList
from hydra._internal.hydra import Hydra
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins

from ctgraph_rl import packages
from ctgraph_rl import run as run_module

UNLUCKY = 13
"""A seed that fails."""


def command_line(monkeypatch, *arguments: str) -> int:
    """The exit code of ``ctgraph-rl ARGUMENTS`` in this process."""
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    monkeypatch.setattr(sys, "argv", ["ctgraph-rl", *arguments])
    monkeypatch.setattr(Hydra, "get_mode", lambda *_, **__: None)  # composes for hydra.mode alone, which no test sets
    try:
        run_module.main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def sweep(monkeypatch, *settings: str) -> int:
    """The exit code of ``ctgraph-rl -m SETTINGS`` in this process."""
    return command_line(monkeypatch, "-m", *settings)


def configs(runs: list[Path]) -> list[dict[str, Any]]:
    """What was run."""
    return [json.loads((path / "run.jsonl").read_text())["config"] for path in runs]


def files_in(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


create_defaults_list = config_loader_impl.create_defaults_list
compose_from_defaults_list = ConfigLoaderImpl._compose_config_from_defaults_list


def compose_once(patch: pytest.MonkeyPatch) -> None:
    """Let Hydra keep what it made of equal files and choices; it reads a file again that has changed."""
    Plugins.instance()  # first: it executes the modules of the sources again
    for scheme in ("file", "pkg"):
        source = SourcesRegistry.instance().resolve(scheme)
        patch.setattr(source, "load_config", _parsed_once(source.load_config))
    lists: dict[Any, DefaultsList] = {}
    merged: dict[int, bytes] = {}
    own = {"pkg://hydra.conf", f"file://{packages.conf_dir()}", "structured://"}

    def list_once(repo: Any, config_name: str | None, overrides_list: list[Any], **how: Any) -> DefaultsList:
        others = [source for source in repo.get_sources() if f"{source.scheme()}://{source.path}" not in own]
        if any(source.scheme() != "file" for source in others):
            return create_defaults_list(repo, config_name, overrides_list, **how)
        choices = [each for each in overrides_list if _chooses(repo, each)]
        key = (config_name, *(each.input_line for each in choices), *how.items(), *map(_content, others))
        if key not in lists:
            lists[key] = create_defaults_list(repo, config_name, choices, **how)
        settings = [each for each in overrides_list if not each.is_sweep_override() and each not in choices]
        kept = lists[key]
        return DefaultsList(kept.defaults, kept.defaults_tree, settings, kept.overrides)

    def merge_once(loader: ConfigLoaderImpl, defaults: list[Any], repo: Any) -> Any:
        if not any(kept.defaults is defaults for kept in lists.values()):
            return compose_from_defaults_list(loader, defaults, repo)
        if id(defaults) not in merged:
            merged[id(defaults)] = pickle.dumps(compose_from_defaults_list(loader, defaults, repo))
        return pickle.loads(merged[id(defaults)])

    patch.setattr(OverridesParser, "parse_rule", _read_once(OverridesParser.parse_rule))
    patch.setattr(CachingConfigRepository, "__init__", _of_one_delegate)
    patch.setattr(config_loader_impl, "create_defaults_list", list_once)
    patch.setattr(ConfigLoaderImpl, "_compose_config_from_defaults_list", merge_once)


def _of_one_delegate(repo: CachingConfigRepository, delegate: Any) -> None:
    """As Hydra's, with a shallow copy of what it asks: it replaces the list of sources and changes none of them."""
    repo.delegate = copy.copy(delegate)
    repo.cache = {}


def _content(source: Any) -> tuple[Any, ...]:
    """The files of a user's folder."""
    files = sorted(Path(source.path).rglob("*.yaml"))
    return source.path, source.provider, *((path, path.read_bytes()) for path in files)


def _chooses(repo: Any, override: Any) -> bool:
    """Whether it chooses files of a group."""
    if override.is_sweep_override() or not repo.group_exists(override.key_or_group):
        return False
    return not isinstance(override.value(), dict)


def _parsed_once(load_config: Callable[..., Any]) -> Callable[..., Any]:
    parsed: dict[Any, bytes] = {}

    def load(source: Any, config_path: str) -> Any:
        path = Path(source.path, f"{config_path.removesuffix('.yaml')}.yaml")
        key = (path, source.provider, path.exists() and path.read_bytes())
        if key not in parsed:
            parsed[key] = pickle.dumps(load_config(source, config_path))
        return pickle.loads(parsed[key])

    return load


def _read_once(parse_rule: Callable[..., Any]) -> Callable[..., Any]:
    """Of one override, which says the same each time; Hydra's functions, such as ``range``, are always the same."""
    read: dict[Any, bytes] = {}

    def parse(parser: OverridesParser, text: str, rule_name: str) -> Any:
        if (text, rule_name) not in read:
            read[text, rule_name] = pickle.dumps(parse_rule(parser, text, rule_name))
        return pickle.loads(read[text, rule_name])

    return parse
