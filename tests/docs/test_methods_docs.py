"""The page about methods: its list and hooks are the present ones, and its example runs as an outsider would run it."""

from __future__ import annotations

import re
import shlex
import sys
from dataclasses import replace
from functools import partial
from inspect import isfunction
from pathlib import Path

import pytest
import torch
from helpers.paths import CHECKOUT
from helpers.small_agents import batches
from helpers.sweeping import command_line
from omegaconf import OmegaConf

import curricula
from baselines.methods.__main__ import main, needs_ids
from baselines.methods.finetune import Finetune
from baselines.methods.l2 import L2
from baselines.methods.method import Method
from baselines.methods.multitask import Multitask
from baselines.methods.parts.weights import flat
from baselines.parts.catalogue import catalogue
from baselines.parts.hooks import Hooks
from baselines.parts.learner import Learner
from ctgraph_rl import CTGraphEnv, Protocol, RunLog, cli, load
from ctgraph_rl.packages import conf_dir
from ctgraph_rl.runs.config import target
from ctgraph_rl.runs.train import new_agent
from curricula.paper import ct_su_b1

TEXT = (CHECKOUT / "docs" / "reference" / "methods.md").read_text(encoding="utf-8")
OWN = (CHECKOUT / "docs" / "how-to" / "own_method.md").read_text(encoding="utf-8")
OWN_AGENT = (CHECKOUT / "docs" / "how-to" / "own_agent.md").read_text(encoding="utf-8")
YAML = {path.stem: path for path in sorted(Path(conf_dir(), "method").glob("*.yaml"))}


def blocks(language: str, page: str = TEXT) -> list[str]:
    """The code blocks of a page in a language."""
    fenced = re.findall(r"^```(\w*)\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    return [content for marked, content in fenced if marked == language]


def test_the_page_shows_the_list_of_detectors_as_it_is_printed(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["baselines.methods"])
    main()
    printed = capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", ["ctgraph-rl", "methods"])
    cli.main()

    assert printed == capsys.readouterr().out
    assert printed.rpartition("\n\n")[2] in CHECKOUT.joinpath("docs/reference/detectors.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", YAML)
def test_every_yaml_builds_a_method_of_ours(compose, name):
    cfg = compose(f"method={name}")

    built = target(cfg, "method")()

    assert isinstance(built, Method)
    assert type(built).__module__.startswith("baselines.methods.")


def test_every_method_is_listed_but_those_that_only_change_values_of_another():
    unlisted = YAML.keys() - {method.name for method in catalogue("method")}

    assert "ewc_published" in unlisted
    assert [name for name in unlisted if f"method={name}`" not in TEXT] == []


@pytest.mark.parametrize("name", YAML)
def test_a_method_is_named_after_what_it_is_and_its_settings_have_comments(name):
    first, *lines = YAML[name].read_text(encoding="utf-8").splitlines()
    own = lines[1:] if "_target_" in OmegaConf.load(YAML[name]) else []

    assert re.fullmatch(r"# .*\.", first)
    assert [line for line in own if not re.fullmatch(r"\w+: \S+ +# \S.*", line)] == []


@pytest.mark.parametrize("entry", list(catalogue("method")), ids=lambda entry: entry.name)
def test_a_method_refuses_what_the_list_says_that_it_needs(compose, entry):
    name, ids = entry.name, needs_ids(entry)

    def refuses(protocol: Protocol, *overrides: str) -> bool:
        method = target(compose(f"method={name}", *overrides), "method")()
        try:
            method.prepare(replace(curricula.load("su_b1_4tasks"), protocol=protocol))
        except ValueError:
            return True
        return False

    assert not refuses(Protocol("one_hot"))
    assert refuses(Protocol("hidden")) == (ids == "yes")
    assert refuses(Protocol("one_hot", "hidden")) == entry.kind.needs_boundaries
    if ids == "heads=multi":
        assert refuses(Protocol("hidden"), "method.heads=multi")


def counted(cell: str, sizes: dict[str, int]) -> int:
    """Bytes as the page has them, such as ``4 P + 4 T``."""
    return sum(int(factor) * sizes[size] for factor, size in re.findall(r"(\d+) ([PHT])", cell))


BYTES = {
    name: row
    for row in TEXT.split("and for each task |")[1].split("\n\n")[0].splitlines()[2:]
    for name in re.findall(r"`(\w+)`", row.split("|")[1])
    if re.search(r"\d P", row)
}
"""Rows of the table of what methods store, of those that it counts in weights."""


@pytest.mark.parametrize(("name", "row"), BYTES.items(), ids=BYTES)
def test_a_method_stores_the_bytes_that_the_page_says(compose, name, row):
    single = ["method.heads=single"] if "heads" in compose(f"method={name}").method else []
    cfg = compose("curriculum=ct8", "agent=a2c", f"method={name}", *single)
    make_method = target(cfg, "method")
    curriculum = make_method().prepare(target(cfg, "curriculum")())
    agent = new_agent(curriculum, lambda *specs: make_method().attach(target(cfg, "agent")(*specs), curriculum), 0)

    method = agent.method
    stored = sum(each.numel() * each.element_size() for each in (*method.buffers(), *method.parameters()))

    weights, (*_, at_all, by_task, _) = method.weights, row.split("|")
    sizes = {"P": len(weights), "H": int(weights.in_heads.sum()), "T": len(weights.parameters)}
    assert stored == counted(at_all, sizes) + len(curriculum.tasks) * counted(by_task, sizes)


def test_the_page_has_every_hook():
    own = [*vars(Method).items(), *vars(Hooks).items()]
    hooks = {name for name, value in own if isfunction(value) and not name.startswith("_")}

    assert {"prepare", "task_weights", "after_step"} <= hooks
    assert [hook for hook in hooks if f"`{hook}(" not in TEXT] == []


def test_an_outsiders_method_is_one_file_and_one_yaml_and_its_agent_comes_back(tmp_path, monkeypatch):
    (tmp_path / "my_conf" / "method").mkdir(parents=True)
    (tmp_path / "my_method.py").write_text(blocks("python", OWN)[0])
    (tmp_path / "my_conf" / "method" / "l2_init.yaml").write_text(blocks("yaml", OWN)[0])
    start, *settings = blocks("bash", OWN)[0].split("ctgraph_rl.run ")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])

    code = command_line(monkeypatch, *shlex.split(settings[0]), "hydra.run.dir=out")
    del sys.modules["my_method"]

    assert (code, start) == (0, "python -m ")
    training = RunLog.read(tmp_path / "out" / "run.jsonl").of_kind("training")
    assert [m["frames"] for m in training] == [8192 * i for i in range(1, 5)]
    assert all(m["loss_method"] > 0 for m in training)
    names = {}
    exec(compile(blocks("python", OWN)[0], "my_method.py", "exec"), names)
    trained = load(tmp_path / "out", make_method=partial(names["L2Init"], coeff=0.001))
    gap = trained.agent.method.weights.vector() - trained.agent.method.first
    assert gap.abs().max() > 0


def members_of_methods(compose) -> set[str]:
    """The members that some method needs of an agent."""
    methods = [target(compose(f"method={name}"), "method")() for name in YAML]
    return {member for each in methods if not isinstance(each, (Finetune, Multitask)) for member in each.agent_members}


def test_the_page_says_what_each_member_is_and_a_learner_has_them(compose):
    members = members_of_methods(compose)

    assert [name for name in members if not re.search(rf"^\|[^|]*`{name}[(`][^|]*\| [^|`]", TEXT, re.MULTILINE)] == []
    assert {name for name in members if hasattr(Learner, name)} | {"method", "output_keys"} == members


def test_an_agent_that_is_no_learner_learns_with_the_gradient_step_of_the_page():
    """Plain gradient descent on the losses of the page about agents and the penalty of L2, against it by hand."""
    names: dict = {}
    exec(blocks("python", OWN_AGENT)[0], names)
    exec(blocks("python")[-1], names)
    specs = CTGraphEnv([ct_su_b1()])
    agent = names["MyAgent"](specs.observation_spec_unbatched, specs.action_spec_unbatched, 4, 3, learning_rate=0.1)
    agent.method, agent.weights = Hooks(), list(agent.policy.parameters())
    agent.optimiser = torch.optim.SGD(agent.weights, 0.1)
    learned = []
    agent.gradient_step = lambda batch: (learned.append(batch), names["gradient_step"](agent, batch))[1]
    attached = L2(coeff=3.0, heads="single").attach(agent, curricula.load("su_b1_4tasks"))
    attached.end_task()
    weights, before = attached.method.weights, attached.method.anchor + 0.5
    weights.write(before)

    losses = attached.learn(batches(attached, ct_su_b1(), 1)[0])

    after = weights.vector().detach()
    weights.write(before)
    own = flat(torch.autograd.grad(agent.loss(learned[0])["loss_policy"], agent.weights))
    torch.testing.assert_close(after, before - 0.1 * (own + 2 * 3.0 * 0.5))
    assert losses["loss_method"] == pytest.approx(3.0 * 0.25 * len(weights)) and "loss_policy" in losses
