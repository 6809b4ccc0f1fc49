"""The page that plays in the browser: the bits of Python by the same kernel, its closed forms, and its errors."""

from __future__ import annotations

import base64
import hashlib
import json
import random
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.paths import CHECKOUT

from ctgraph_rl.batch import native
from ctgraph_rl.batch.rows import Rows
from ctgraph_rl.core.graph import CTGraph
from ctgraph_rl.tasks import configurations
from ctgraph_rl.tasks.configurations import observations_of
from ctgraph_rl.tasks.images import PaperImages
from ctgraph_rl.tasks.task import Task

PLAY = CHECKOUT / "docs" / "_static" / "play"
IN_NODE = Path(__file__).parent / "play" / "run_in_node.js"

PRESETS = {
    "CT-FO-B1": configurations.ct_fo_b1,
    "CT-SU-B1": configurations.ct_su_b1,
    "CT-CO-B1": configurations.ct_co_b1,
    "CT-POSR-B1": configurations.ct_posr_b1,
    "CT-FO-B2": configurations.ct_fo_b2,
}

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

ROWS, STEPS = 70, 24  # more rows than a block of the kernel


def in_node(cases: list[tuple[str, Any]], folder: Path = PLAY) -> list[Any]:
    """Return what functions of the page in a folder answer."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("needs node")
    done = subprocess.run([node, str(IN_NODE), str(folder)], input=json.dumps(cases), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def kernel_js() -> dict[str, str]:
    """Return the fields of the built file."""
    return dict(re.findall(r'^  (\w+): "(.*)",$', (PLAY / "kernel.js").read_text(), flags=re.MULTILINE))


def setting(rng: random.Random) -> dict[str, Any]:
    """Return parameters that the page takes."""
    while True:
        b, d = rng.randint(2, 5), rng.randint(1, 8)
        shown = rng.choice(["full", "surjective", "confounding"])
        if shown != "full" or CTGraph(b, d).num_states <= 256:
            break
    goal = "".join(str(rng.randint(1, b)) for _ in range(d))
    return {"b": b, "d": d, "p": rng.choice([0, 0.5, rng.random()]), "shown": shown, "goal": goal}


def task_of(given: dict[str, Any]) -> Task:
    """Return the task that the page makes of parameters."""
    graph = CTGraph(given["b"], given["d"], given["p"])
    observations = observations_of(graph, given["shown"])
    return Task(graph, tuple(map(int, given["goal"])), observations, PaperImages(observations.last_id + 1, 1))


def trajectory(given: dict[str, Any], seed: int) -> tuple[list[int], dict[str, Any]]:
    """Return random actions, and the parameters and SHA-256 of all that Python's kernel makes of them."""
    rows = Rows([task_of(given)] * ROWS, seed=seed)
    if not rows.uses_kernel:
        pytest.skip("needs the compiled kernel")
    rows.reset()
    chances = [6.0, *[1.0] * given["b"], 0.5]  # mostly waits, and an action that no state knows
    action = torch.multinomial(torch.tensor(chances), STEPS * ROWS, True, generator=torch.Generator().manual_seed(seed))
    shape, images = (STEPS, ROWS), (STEPS, ROWS, 144)
    made = {
        "observation": torch.empty(images, dtype=torch.uint8),
        "following": torch.empty(images, dtype=torch.uint8),
        "done": torch.empty(shape, dtype=torch.bool),
        "outcome": torch.empty(shape, dtype=torch.uint8),
        "leaf": torch.empty(shape, dtype=torch.int64),
        "step_count": torch.empty(shape, dtype=torch.int64),
        "reward": torch.empty(shape),
        "episode_reward": torch.empty(shape),
    }
    state = rows.engine.run(rows.state, STEPS, True, action=action, **made)
    page_names = {"step_count": "steps", "reward": "rewards", "episode_reward": "returns"}
    found = {page_names.get(name, name): value for name, value in made.items()}
    found |= {"kind": state.state_type, **{name: getattr(state, name) for name in ("node", "tick", "step_count")}}
    found |= {name: getattr(state, name) for name in ("episode_reward", "reward", "paid")}
    sums = {name: hashlib.sha256(value.contiguous().numpy().tobytes()).hexdigest() for name, value in found.items()}
    packed = [str(number) for number in native._pack(rows.engine.tables)[0].tolist()]
    return action.tolist(), {"packed": packed, "sums": sums}


def check_trajectories(numbers: range, folder: Path = PLAY) -> None:
    settings = {number: setting(random.Random(number)) for number in numbers}
    python = {number: trajectory(given, number) for number, given in settings.items()}
    cases = [
        ("play", {"task": settings[n], "seed": n, "actions": python[n][0], "steps": STEPS, "count": ROWS})
        for n in numbers
    ]

    for number, answer in zip(numbers, in_node(cases, folder), strict=True):
        assert answer == python[number][1], settings[number]


def test_the_page_plays_with_the_bits_of_python():
    check_trajectories(range(12))


@pytest.mark.slow
def test_the_page_plays_200_settings_with_the_bits_of_python():
    check_trajectories(range(12, 212))


def test_presets_are_the_configurations_of_the_paper():
    text = (PLAY / "graph.js").read_text()
    pattern = r'"(CT-[\w-]+)": \{ b: (\d), d: (\d), p: ([\d.]+), shown: "(\w+)" \}'
    found = {
        name: task_of({"b": int(b), "d": int(d), "p": float(p), "shown": shown, "goal": "1" * int(d)})
        for name, b, d, p, shown in re.findall(pattern, text)
    }

    assert found == {name: configuration() for name, configuration in PRESETS.items()}


def test_the_numbers_of_a_graph_are_those_of_python():
    settings = [setting(random.Random(number)) for number in range(300, 340)]
    answers = in_node([(what, [given]) for given in settings for what in ("closedForms", "ceilings")])

    for given, forms, ceilings in zip(settings, answers[::2], answers[1::2], strict=True):
        task = task_of(given)
        graph = task.graph
        expected = {
            "states": graph.num_states,
            "rewardProb": graph.reward_prob_random,
            "endProb": graph.end_prob_random,
            "navigationProb": graph.reward_prob_navigation,
            "length": graph.expected_episode_length,
            "search": graph.expected_search_episodes,
        }
        assert forms == pytest.approx(expected, rel=1e-12)
        drawn, fixed = task.memoryless_ceiling(), task.memoryless_ceiling(deterministic=True)
        assert ceilings == pytest.approx({"drawn": drawn, "fixed": fixed}, rel=1e-12)


def test_the_built_kernel_is_that_of_the_c_file_and_pinned():
    made = kernel_js()
    sources = hashlib.sha256((CHECKOUT / "ctgraph_rl" / "core" / "kernel.c").read_bytes()).hexdigest()

    assert made["source"] == sources, "kernel.c has changed: python docs/_ext/browser_kernel.py"
    assert hashlib.sha256(base64.b64decode(made["wasm"])).hexdigest() == made["module"]
    assert base64.b64decode(made["images"]) == PaperImages(256, 1).images.numpy().tobytes()
    assert sum(path.stat().st_size for path in PLAY.iterdir()) < 200_000


def test_the_kernel_built_here_is_the_same_file_or_by_another_compiler_has_the_bits_of_python(tmp_path, monkeypatch):
    if shutil.which("clang-14") is None or shutil.which("wasm-ld-14") is None:
        pytest.skip("needs clang-14, lld-14, wasi-libc and libclang-rt-14-dev-wasm32")
    monkeypatch.syspath_prepend(str(CHECKOUT / "docs" / "_ext"))
    import browser_kernel

    built = browser_kernel.text()
    if browser_kernel.compiler() == kernel_js()["compiler"]:
        assert built == (PLAY / "kernel.js").read_text()
        return
    (tmp_path / "kernel.js").write_text(built)
    shutil.copy(PLAY / "graph.js", tmp_path)
    check_trajectories(range(12), tmp_path)


GIVEN = {"b": 2, "d": 2, "p": 0.5, "shown": "full"}


REFUSED = (
    ({"b": 6}, "b must be an integer in 2..5 on this page, got 6."),
    ({"d": 1.5}, "d must be an integer in 1..8 on this page, got 1.5."),
    ({"p": 1}, "p must be in [0, 1), got 1."),
    ({"p": None}, "p must be in [0, 1), got null."),
    ({"shown": "x"}, "The observations must be full, surjective, confounding, got x."),
    ({"d": 7}, "A fully observable graph needs an image for each of its 512 states"),
)


def test_a_value_out_of_range_is_refused_with_the_rule():
    taken, *answers = in_node([("refusal", [GIVEN | change]) for change in ({}, *(change for change, _ in REFUSED))])

    assert taken is None
    for answer, (_, message) in zip(answers, REFUSED, strict=True):
        assert answer.startswith(message)


def test_a_drawn_goal_takes_two_branches_and_can_be_each_of_those():
    (goals,) = in_node([("drawnGoals", [{"b": 3, "d": 2}, 300])])

    assert set(goals) == {"12", "13", "21", "23", "31", "32"}
    assert in_node([("drawnGoals", [{"b": 2, "d": 1}, 50])])[0].count("2") in range(10, 40)


NO_LOGS = (
    ("", "This is no log of a run: its first line does not say what was run."),
    ("garbage\n", "This is no log of a run: line 1 is no measurement."),
    ('{"kind": "training"}\n', "This is no log of a run: its first line does not say what was run."),
    ('{"kind": "run"}\n', "This log has no evaluation yet."),
)


def test_what_is_no_log_is_named_as_such():
    answers = in_node([("performanceMatrix", [text]) for text, _ in NO_LOGS])

    assert answers == [{"error": message} for _, message in NO_LOGS]


def test_a_log_gives_the_performance_matrix_and_the_ends_of_episodes():
    ends = {"success_rate": 0.25, "end_rate": 0.75}
    solved = {"success_rate": 1.0, "end_rate": 1.0}
    lines = [
        {"kind": "run", "curriculum": "mine"},
        {"kind": "evaluation", "block": 0, "frames": 0, "task": 1, "return_mean": 0.25, "label": "goal 1", **ends},
        {"kind": "evaluation", "block": 1, "frames": 32, "task": 1, "return_mean": 0.5, "moment": "during"},
        {"kind": "evaluation", "block": 1, "frames": 64, "task": 1, "return_mean": 1.0, **solved},
        {"kind": "evaluation", "block": 1, "frames": 64, "task": 2, "return_mean": None},
        {"kind": "evaluation", "block": 1, "frames": 64, "task": 3, "return_mean": 0.1, "held_out": True},
    ]
    text = "".join(json.dumps(line) + "\n" for line in lines) + '{"kind": "torn'

    (found,) = in_node([("performanceMatrix", [text])])

    assert (found["name"], found["tasks"], found["labels"]) == ("mine", [1, 2], ["goal 1", "task 2"])
    assert [row["returns"] for row in found["rows"]] == [{"1": 0.25}, {"1": 1.0, "2": None}]
    assert [row["ends"] for row in found["rows"]] == [
        {"1": "goal 25 %,\nother ends 50 %,\nfail 25 %"},
        {"1": "goal 100 %,\nother ends 0 %,\nfail 0 %", "2": ""},
    ]


ERRORS = """<script>
const errors = [];
addEventListener("error", (event) => errors.push(event.message));
console.error = (...words) => errors.push(words.join(" "));
</script>"""

PLAYED = """<script>
const text = (id) => document.getElementById("ct-" + id).textContent;
const goal = [...task.goal];
const leaks = [];
const look = () => {
  const marks = document.querySelectorAll("#ct-play .here, #ct-play .goal").length;
  const seen = document.getElementById("ct-play").outerHTML + location.href + document.title;
  if (marks || seen.includes(goal.join("")) || seen.includes(goal.join("."))) leaks.push(text("outcome"));
};
const press = (key) => {
  document.body.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
  if (!document.getElementById("ct-reveal").checked) look();
};
const toTheGoal = () => { press("0"); for (const branch of goal) { press("0"); press(branch); } };
const found = { refused: text("refusal"), link: location.hash, preset: document.getElementById("ct-preset").value };
look();
found.before = [text("own"), text("random"), text("drawn")];
toTheGoal();
const last = document.getElementById("ct-actions").children[0];
last.focus();
last.click();
found.focus = document.activeElement === last && last.ariaDisabled;
found.outcome = text("outcome");
found.after = [text("own"), text("drawn"), text("fixed")];
found.tree = document.getElementById("ct-tree").getAttribute("aria-label");
press("n");
found.again = text("outcome");
for (const key of "01") press(key);
found.failed = text("own");
found.leaks = leaks;
press("n");
document.getElementById("ct-reveal").click();
toTheGoal();
press("0");
found.shown = text("hidden") === `You are at the end state of node ${rows.node[0]}. The goal is ${goal.join(".")}. `
  + "This episode does not count.";
found.marks = [document.querySelectorAll("circle.here").length, document.querySelectorAll("circle.goal").length];
found.uncounted = [text("outcome"), text("own")];
document.getElementById("ct-another").click();
found.new = [text("own"), text("drawn")];
const b = document.getElementById("ct-b");
b.value = "9";
b.dispatchEvent(new Event("change"));
found.wrong = text("refusal");
found.wide = document.documentElement.scrollWidth <= window.innerWidth;
document.getElementById("ct-simulate").click();
const lines = [
  { kind: "run", curriculum: "mine" },
  { kind: "evaluation", block: 0, frames: 0, task: 1, label: "goal1.2",
    return_mean: 0.5, success_rate: 0.5, end_rate: 0.8 },
];
const file = new File(lines.map((line) => JSON.stringify(line) + "\\n"), "run.jsonl");
showLog(file).then(() => setTimeout(() => {
  const answer = { ...found, log: text("log"), measured: text("measured"), errors };
  const cells = document.querySelectorAll("#ct-matrix td, #ct-matrix [scope=row]");
  answer.cells = [...cells].map((cell) => cell.textContent);
  document.querySelector("#ct-matrix button").click();
  const fills = [...document.querySelectorAll("#ct-visits circle")].slice(-4);
  answer.visits = fills.map((mark) => [mark.style.fillOpacity, mark.classList.contains("goal")]);
  answer.ends = text("ends");
  document.body.dataset.found = JSON.stringify(answer);
}, 1000));
</script>"""


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="needs a browser: apt-get install chromium")
@pytest.mark.parametrize("width", [360, 1600])
def test_a_browser_plays_a_game_to_its_goal_which_nothing_on_the_page_tells(tmp_path, width):
    page = (CHECKOUT / "docs" / "tutorials" / "play_and_explore.md").read_text()
    form = page[page.index("<div id=") : page.rindex("</script>") + len("</script>")]
    shutil.copytree(PLAY, tmp_path / "_static" / "play")
    (tmp_path / "tutorials").mkdir()
    (tmp_path / "tutorials" / "page.html").write_text(f"<!doctype html><meta charset=utf-8>{ERRORS}{form}{PLAYED}")
    link = "b=2&d=6&p=0&shown=surjective"
    words = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", f"--window-size={width},900", "--dump-dom"]
    done = subprocess.run(
        [*words, "--virtual-time-budget=20000", f"file://{tmp_path}/tutorials/page.html#{link}"],
        capture_output=True,
        text=True,
        timeout=600,
    )

    said = re.search(r'data-found="([^"]*)"', done.stdout)
    assert said, done.stdout[-2000:] + done.stderr
    found = json.loads(unescape(said[1]))
    assert (found["refused"], found["link"], found["preset"]) == ("", f"#{link}", "")
    assert (found["leaks"], found["errors"]) == ([], [])
    own, random_share, drawn = found["before"]
    assert (own, drawn) == ("no episode yet", "after your first success")
    assert float(random_share) == pytest.approx(CTGraph(2, 6).reward_prob_random, rel=1e-3)
    assert found["outcome"] == "The episode ends after 14 steps: goal, reward 1. Press n for a new one."
    assert found["focus"] == "true"
    own, drawn, fixed = found["after"]
    assert (own, fixed, 0 < float(drawn) < 1) == ("1 (1 of 1)", "0", True)
    assert found["tree"] == "The tree of 64 end states."
    assert found["again"].startswith("A new episode begins")
    assert found["failed"] == "0.5 (1 of 2)"
    assert (found["shown"], found["marks"]) == (True, [1, 1])
    assert found["uncounted"] == [found["outcome"], "0.5 (1 of 2)"]
    assert found["new"] == ["no episode yet", "after your first success"]
    assert found["wrong"] == "b must be an integer in 2..5 on this page, got 9."
    assert found["wide"]
    assert re.match(r"[\d,]+ of [\d,]+ random episodes reach the goal, a share of ", found["measured"])
    assert found["log"].startswith(
        "run.jsonl: mine. Mean return on each task after each block, and where episodes ended;"
    )
    assert found["cells"] == ["0", "0", "0.5goal 50 %,\nother ends 30 %,\nfail 20 %tree"]
    assert found["visits"] == [["0.2", False], ["1", True], ["0.2", False], ["0.2", False]]
    assert found["ends"].startswith("goal1.2 after 0 frames: goal 50 %, other ends 30 %, fail 20 %. End states are")
