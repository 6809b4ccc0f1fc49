"""Hydra in tests: each file is parsed once in a process, and those of equal choices are found and merged once.

A configuration is what the choices of groups give, with settings on top of it. The first is kept for equal choices
where all files are of this package and of Hydra, which stay equal while tests run; the second is done each time.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository
from hydra._internal.defaults_list import DefaultsList
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.plugins import Plugins

from ctgraph_rl import packages

create_defaults_list = config_loader_impl.create_defaults_list
compose_from_defaults_list = ConfigLoaderImpl._compose_config_from_defaults_list


def compose_once(patch: pytest.MonkeyPatch) -> None:
    """Let Hydra keep what it made of equal files and choices; it reads a file again that has changed."""
    Plugins.instance()  # first: it executes the modules of the sources again
    for scheme in ("file", "pkg"):
        source = SourcesRegistry.instance().resolve(scheme)
        patch.setattr(source, "load_config", _parsed_once(source.load_config))
    lists: dict[Any, DefaultsList] = {}
    merged: dict[int, Any] = {}
    own = {"pkg://hydra.conf", f"file://{packages.conf_dir()}", "structured://"}

    def list_once(repo: Any, config_name: str | None, overrides_list: list[Any], **how: Any) -> DefaultsList:
        if not own.issuperset(f"{source.scheme()}://{source.path}" for source in repo.get_sources()):
            return create_defaults_list(repo, config_name, overrides_list, **how)
        choices = [each for each in overrides_list if _chooses(repo, each)]
        key = (config_name, *(each.input_line for each in choices), *how.items())
        if key not in lists:
            lists[key] = create_defaults_list(repo, config_name, choices, **how)
        settings = [each for each in overrides_list if not each.is_sweep_override() and each not in choices]
        kept = lists[key]
        return DefaultsList(kept.defaults, kept.defaults_tree, settings, kept.overrides)

    def merge_once(loader: ConfigLoaderImpl, defaults: list[Any], repo: Any) -> Any:
        if not any(kept.defaults is defaults for kept in lists.values()):
            return compose_from_defaults_list(loader, defaults, repo)
        if id(defaults) not in merged:
            merged[id(defaults)] = compose_from_defaults_list(loader, defaults, repo)
        return copy.deepcopy(merged[id(defaults)])

    patch.setattr(CachingConfigRepository, "__init__", _of_one_delegate)
    patch.setattr(config_loader_impl, "create_defaults_list", list_once)
    patch.setattr(ConfigLoaderImpl, "_compose_config_from_defaults_list", merge_once)


def _of_one_delegate(repo: CachingConfigRepository, delegate: Any) -> None:
    """As Hydra's, with a shallow copy of what it asks: it replaces the list of sources and changes none of them."""
    repo.delegate = copy.copy(delegate)
    repo.cache = {}


def _chooses(repo: Any, override: Any) -> bool:
    """Whether it chooses files of a group."""
    if override.is_sweep_override() or not repo.group_exists(override.key_or_group):
        return False
    return not isinstance(override.value(), dict)


def _parsed_once(load_config: Callable[..., Any]) -> Callable[..., Any]:
    parsed: dict[Any, Any] = {}

    def load(source: Any, config_path: str) -> Any:
        path = Path(source.path, f"{config_path.removesuffix('.yaml')}.yaml")
        key = (path, source.provider, path.exists() and path.read_bytes())
        if key not in parsed:
            parsed[key] = load_config(source, config_path)
        return copy.deepcopy(parsed[key])

    return load
