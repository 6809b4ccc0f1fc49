"""The bits of tiny portable runs of every agent with every method: what the numbers version stands for.

``python -m tests.baselines.pinned`` writes ``tests/data/numbers_N.json`` for the present ``NUMBERS`` N of
``ctgraph_rl/log/provenance.py``. Raise that first: it says that equal configurations and seeds give other numbers.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from pathlib import Path
from typing import Any

from ctgraph_rl.portable import Restart, become_portable, hold, restart

sys.path.append(str(Path(__file__).resolve().parents[1]))  # has the helpers

DATA = Path(__file__).resolve().parents[1] / "data"

TINY = ["agent.num_envs=8", "agent.num_steps=4", "agent.hidden_size=4"]
REPLAY = ["agent.num_updates=1", "agent.batch_size=4", "agent.buffer_size=64", "agent.target_update_interval=2"]
MINIBATCHES = ["agent.num_minibatches=2", "agent.num_epochs=1"]
ADAPTS = ["agent.adapt_episodes=1", "agent.num_steps=16"]
TRIALS = ["agent.trial_episodes=2", "agent.num_trials=2", "agent.context_size=4", *REPLAY[:3]]
GENERATIONS = ["agent.num_batches=1", "agent.num_trials=1", "agent.num_updates=1", "agent.insert_prob=0.5"]
METHODS = {
    "clear": ["method.buffer_size=48"],
    "mask_sc": ["method.num_samples=4", "method.every=1", "method.threshold=-1"],
    **{name: ["method.num_samples=4"] for name in ("ewc", "ewc_published", "mas", "mask_amsc")},
}
FRAMES = (32, 64)
"""Of the blocks: one batch and two, so that penalties of what was learned before act; with trials four times that."""


def all_digests() -> dict[str, Any]:
    """Return what is stored: versions, and the digest of each agent's run with each method that it can learn with."""
    import torch

    from ctgraph_rl.log.provenance import NUMBERS, versions

    hold()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    made = {group: _builders(group) for group in ("agent", "method")}
    digests = {}
    for agent, make_agent in made["agent"].items():
        for method, make_method in made["method"].items():
            digests[f"{agent} {method}"] = _digest(_curriculum(make_agent), make_agent, make_method)
    return {"numbers": NUMBERS, "torch": versions()["torch"], "digests": digests}


def _builders(group: str) -> dict[str, Any]:
    """Return what builds each tiny agent, or each method."""
    import hydra
    import pytest
    from helpers.sweeping import compose_once

    from ctgraph_rl.packages import conf_dir
    from ctgraph_rl.runs import config

    made = {}
    with pytest.MonkeyPatch.context() as patch, hydra.initialize_config_dir(conf_dir(), version_base="1.3"):
        compose_once(patch)
        for path in sorted(Path(conf_dir(), group).glob("*.yaml")):
            cfg = hydra.compose("config", overrides=[f"{group}={path.stem}"])
            small = METHODS.get(path.stem, [])
            if group == "agent":
                small = [
                    *TINY,
                    *REPLAY * ("target_update_interval" in cfg.agent),
                    *MINIBATCHES * ("num_minibatches" in cfg.agent),
                    *GENERATIONS * ("insert_prob" in cfg.agent),
                    *ADAPTS * ("adapt_episodes" in cfg.agent),
                    *TRIALS * ("context_size" in cfg.agent),
                ]
            made[path.stem] = config.target(hydra.compose("config", overrides=[f"{group}={path.stem}", *small]), group)
    return made


def _curriculum(make_agent: Any) -> Any:
    """Return two blocks that an agent can learn: of a task each, or of both for one that adapts within trials."""
    from helpers.scripted import ONE, TWO, of

    from ctgraph_rl import Block, Evaluation

    if {"adapt_episodes", "context_size"} & make_agent.keywords.keys():
        blocks = [Block((ONE, TWO), 4 * frames) for frames in FRAMES]
        evaluation = Evaluation(2, greedy=False, before=False, adapt_episodes=1)
    else:
        blocks = [Block(task, frames) for task, frames in zip((ONE, TWO), FRAMES, strict=True)]
        evaluation = Evaluation(2, greedy=False, before=False)
    return of(*blocks, evaluation=evaluation, task_id="one_hot")


def _digest(curriculum: Any, make_agent: Any, make_method: Any) -> str:
    """Return the digest of a run's weights and measurements, or why the agent cannot learn with the method."""
    from ctgraph_rl import RunLog, learn_curriculum
    from ctgraph_rl.runs.train import new_agent, with_method

    try:
        curriculum = make_method().prepare(curriculum)
        agent = new_agent(curriculum, with_method(make_agent, make_method, curriculum), 0)
    except ValueError as error:
        return f"refused: {error}"
    log = RunLog()
    learn_curriculum(curriculum, agent, 7, log)
    lines = [{key: value for key, value in line.items() if key != "seconds"} for line in log.measurements]
    found = hashlib.sha256(json.dumps(lines).encode())
    _add(found, agent.state_dict())
    return found.hexdigest()[:16]


def _add(found: Any, value: Any) -> None:
    """Add nested plain values and tensors, bit by bit."""
    import torch

    if isinstance(value, torch.Tensor):
        value = value.detach().contiguous()
        found.update(f"{value.dtype} {list(value.shape)}".encode() + value.view(-1).view(torch.uint8).numpy().tobytes())
    elif isinstance(value, dict):
        for key, inner in value.items():
            found.update(repr(key).encode())
            _add(found, inner)
    elif isinstance(value, (list, tuple)):
        for inner in value:
            _add(found, inner)
    else:
        found.update(repr(value).encode())


def main() -> None:
    """Print the digests, or write them to their file."""
    try:
        become_portable()
    except Restart:
        restart(os.environ, sys.argv[1:])
    found = all_digests()
    if sys.argv[1:] == ["--print"]:
        print(json.dumps(found))
    else:
        path = DATA / f"numbers_{found['numbers']}.json"
        path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        print(path)


if __name__ == "__main__":
    main()
