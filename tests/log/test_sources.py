"""Digests of a user's source: what changes one, what does not, and which modules count."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from zipfile import ZipFile

import pytest

import ctgraph_rl.log.sources
from ctgraph_rl.log.provenance import targets
from ctgraph_rl.log.sources import find_sources, read_module

EVERYTHING = '''
"""A module with the syntax whose trees differ between versions of Python."""
import os.path as path
from . import near
async def run(a, /, b: int = 1, *c, d=u"u", **e) -> None:
    "A docstring."
    async with a as b: yield (await c)
class Empty(Exception, metaclass=type): pass
class Documented(Exception, metaclass=type): "A docstring."
def f(*, x=None, **y):
    def g(): return {**y, 1: 2.5e-300, "k": 1j, b"b": ...}
    match x:
        case {"a": [1, *rest], **others} | Empty(z=-1) if x: return rf"\\caption{{{x!r:>{y}}}}" f"{x}" "tail"
        case _: return f"{x=:{y}} {{}}", lambda *, q=3: [i async for i in x if i]
    try: ...
    except* (ValueError, OSError) as error: raise error from None
    global h; h: list[int]; h = x if y else not x; del h
letter = "\U0002ebf0"
'''

DIGEST = "a9c9036c7784bfec"

VERSIONS = [found for name in ("python3.11", "python3.12", "python3.13") if (found := shutil.which(name))]


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Writes modules of a user into a folder that Python finds them in; they are then as if never imported."""
    monkeypatch.syspath_prepend(tmp_path)
    before = set(sys.modules)

    def write(**texts: str) -> None:
        for name, text in texts.items():
            path = tmp_path / f"{name.replace('__in__', '/')}.py"
            path.parent.mkdir(exist_ok=True, parents=True)
            path.write_text(text)
        for name in set(sys.modules) - before:
            if getattr(sys.modules[name], "__file__", None) and str(tmp_path) in str(sys.modules[name].__file__):
                del sys.modules[name]

    yield write
    write()


def digest(source: str) -> str:
    return read_module("user.module", source.encode()).digest


def test_a_digest_is_that_of_every_version_of_python():
    assert digest(EVERYTHING) == DIGEST


@pytest.mark.parametrize("python", VERSIONS)
def test_other_versions_of_python_that_are_installed_agree(python, tmp_path):
    (tmp_path / "everything.py").write_text(EVERYTHING)
    shutil.copy(ctgraph_rl.log.sources.__file__, tmp_path / "user_sources.py")
    code = "import user_sources as s; print(s.read_module('user.module', open('everything.py', 'rb').read()).digest)"

    result = subprocess.run([python, "-c", code], cwd=tmp_path, capture_output=True, text=True)

    if result.returncode == 127:
        pytest.skip("there is no such Python behind the name")
    assert (result.stdout, result.stderr) == (f"{DIGEST}\n", "")


@pytest.mark.parametrize(
    ("one", "other", "equal"),
    [
        ("x = 1", "# a comment\nx  =  (1)  # another", True),
        ("def f():\n    return 1", 'def f():\n    """Say."""\n\n    return 1', True),
        ("class A:\n    pass", "class A:\n    'Say.'", True),
        ("x = 'a' 'b'", 'x = "ab"', True),
        ("x = 1", "x = 1.0", False),
        ("x = 1", "x = True", False),
        ("x = 'y'", "x = y", False),
        ("x = None", "x: None", False),
        ("f(a, b)", "f([a, b])", False),
        ("x = a - b", "x = b - a", False),
        ("x = {**a}", "x = {None: a}", False),
        ("def f(*, a, b=1): ...", "def f(*, a=1, b): ...", False),
        ("if a:\n    b()\nc()", "if a:\n    b()\n    c()", False),
    ],
)
def test_syntax_alone_decides(one, other, equal):
    assert (digest(one) == digest(other)) is equal


def test_the_users_modules_count_with_all_that_they_import(write):
    write(
        mine="import json, numpy, mine_a\nfrom mine_package.inner import thing\nclass Agent: ...",
        mine_a="def f():\n    import mine_b\n    from importlib import import_module\n    import_module('mine_c')",
        mine_b="import mine_a, torch.nn, no_such_module",
        mine_c="",
        mine_d="",
        mine_package__in____init__="",
        mine_package__in__inner="from . import beside\nfrom .deep import value as thing\nfrom ..mine_d import x",
        mine_package__in__beside="from ctgraph_rl import Task",
        mine_package__in__deep="value = 1",
        mine_package__in__unused="",
    )

    found = find_sources(["mine.Agent", "baselines.ppo.PPO", "torch.optim.Adam", "functools.partial"])

    inner = [f"mine_package.{name}" for name in ("beside", "deep", "inner")]
    assert list(found) == ["mine", "mine_a", "mine_b", "mine_c", "mine_package", *inner]
    assert "mine" not in sys.modules, "to look at a module is not to run it"


def test_an_edit_of_an_imported_module_changes_its_digest_alone(write):
    write(mine="from mine_a import *", mine_a="x = 1")
    before = find_sources(["mine.Agent"])

    write(mine_a="x = 2")

    after = find_sources(["mine.Agent"])
    assert {name for name in after if after[name] != before[name]} == {"mine_a"}


def test_an_edit_does_not_change_what_this_process_has_imported(write, tmp_path):
    write(mine="x = 1")
    import mine  # type: ignore[import-not-found]

    before = find_sources(["mine.Agent"])
    (tmp_path / "mine.py").write_text("x = 2")

    assert mine.x == 1 and find_sources(["mine.Agent"]) == before
    write()
    assert find_sources(["mine.Agent"]) != before


def test_an_installed_package_counts_by_its_version():
    assert find_sources(["rich.console.Console"])["rich"].startswith("version ")
    assert find_sources(["yaml.Loader"])["yaml"].startswith("version "), "another name than that of what is installed"


def test_what_cannot_be_read_is_unknown(monkeypatch):
    monkeypatch.delattr(sys.modules["__main__"], "__file__", raising=False)

    assert find_sources(["__main__.Agent"]) == {"__main__": None}


@pytest.mark.parametrize("name", ["made_by_hand.Agent", "removed.Agent", "archived.Agent", "__mp_main__.NoSuchClass"])
def test_what_has_no_file_is_unknown(name, write, tmp_path, monkeypatch):
    write(removed="x = 1")
    import removed  # type: ignore[import-not-found]

    Path(removed.__file__).unlink()
    monkeypatch.setitem(sys.modules, "made_by_hand", ModuleType("made_by_hand"))
    with ZipFile(tmp_path / "archive.zip", "w") as archive:
        archive.writestr("archived.py", "x = 1")
    monkeypatch.syspath_prepend(tmp_path / "archive.zip")
    monkeypatch.setattr(sys.modules["__main__"], "__file__", __file__, raising=False)

    assert list(find_sources([name]).values()) == [None]


def test_packages_without_init_within_others_are_found_without_their_import(write):
    write(mine__in__deep__in__agent="def f():\n    import mine.other.part", mine__in__other__in__part="")

    assert list(find_sources(["mine.deep.agent.Agent"])) == ["mine.deep.agent", "mine.other.part"]


def test_modules_that_are_imported_by_a_relative_name_or_a_keyword_count(write):
    imports = "from importlib import import_module as i\nimport importlib as l\nl.import_module('.a', 'mine')"
    write(mine__in____init__=f"{imports}\nl.import_module(name='mine_b')", mine__in__a="", mine_b="")

    assert list(find_sources(["mine.Agent"])) == ["mine", "mine.a", "mine_b"]


@pytest.mark.parametrize("change", ["Agent.size = 2", "WIDTHS['x'] = 2", "Agent.net.sizes[0] = 2"])
def test_attributes_and_items_that_a_script_sets_count(change, tmp_path, monkeypatch):
    script = tmp_path / "script.py"
    monkeypatch.setattr(sys.modules["__main__"], "__file__", str(script), raising=False)
    found = []
    for more in ("", "Other.size = 2\n", change):
        script.write_text(f"WIDTHS = {{}}\nclass Agent:\n    net = WIDTHS\nclass Other: ...\n{more}")
        found.append(find_sources(["__main__.Agent"]))

    assert found[0] == found[1] != found[2]


def test_of_a_script_what_a_class_needs_counts(tmp_path, write):
    write(helper="x = 1", other="x = 1")
    script = """
        import sys, json, helper
        SEED = {seed}
        SIZE = {size}
        if SEED:
            import other
        def width(): return SIZE + helper.x
        class Agent:
            size = width()
        from ctgraph_rl.log.provenance import full_name
        from ctgraph_rl.log.sources import find_sources
        print(json.dumps(find_sources([full_name(Agent)])))
    """

    def run(seed: int, size: int) -> dict[str, str]:
        path = tmp_path / "script.py"
        path.write_text("\n".join(line[8:] for line in script.format(seed=seed, size=size).splitlines()))
        return json.loads(subprocess.run([sys.executable, path], capture_output=True, text=True, check=True).stdout)

    first = run(1, 1)
    assert list(first) == ["__main__", "helper"]
    assert run(2, 1) == first != run(1, 2)


def test_targets_are_found_at_any_depth():
    settings = {
        "agent": {"_target_": "mine.Agent", "loss": {"_target_": "mine.loss", "_partial_": True}, "gamma": 1},
        "images": [{"_target_": "hydra.utils.get_class", "path": "mine.Images"}],
    }

    assert list(targets(settings)) == ["mine.Agent", "mine.loss", "mine.Images"]


def test_what_is_no_python_counts_byte_by_byte():
    assert read_module("mine", b"x = (").digest != read_module("mine", b"x = ((").digest
    for much in (f"0x{'f' * 5000}", f"{'-' * 5000}1"):
        assert digest(f"x = {much}") != digest(f"y = {much}")
    assert Path(ctgraph_rl.log.sources.__file__).read_text().count("import ctgraph_rl") == 0
