"""Files of strangers: what has two meanings is refused in one line, and so is what takes more than its file says."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable
from typing import Any

import pytest
import yaml

from ctgraph_rl import strict
from ctgraph_rl.log.measurement import check
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.log.sums import metrics_of

LINE = b'{"kind": "run", "curriculum": "a", "config": {"seed": 0}}\n'

VALID: dict[str, bytes] = {
    "json": json.dumps({"a": [1, -2.5e-3, None, True, "x\u00e9"], "b": {"c": {}}}, indent=2).encode(),
    "lines": LINE + b'{"kind": "training", "block": 1, "frames": 64, "return_mean": 0.5}\n' * 2,
    "yaml": yaml.safe_dump({"name": "x", "seeds": [1, 2], "hours": 0.5, "none": None, "part": {"yes": True}}).encode(),
}

READERS: dict[str, Callable[[bytes], Any]] = {
    "json": strict.json_value,
    "lines": lambda content: RunLog.of_content(content, "run.jsonl").measurements,
    "yaml": strict.yaml_value,
}


@pytest.mark.parametrize("name", VALID)
def test_what_is_whole_is_read(name):
    read = READERS[name](VALID[name])

    assert read
    if name == "json":
        assert read == json.loads(VALID[name])
    if name == "yaml":
        assert read == yaml.safe_load(VALID[name])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("json", b'{"a": 1, "a": 2}', "key 'a' occurs twice in one object"),
        ("json", b'{"a": NaN}', "NaN is no number of JSON"),
        ("json", b'{"a": 1e999}', "1e999 is beyond what a float64 holds"),
        ("json", b"1" * 401, "an integer has 401 digits, the limit is 40"),
        ("json", b"[" * 10**5, "nested more than 32 deep"),
        ("json", b"[" * 33 + b"]" * 33, "nested more than 32 deep"),
        ("json", '{"a": 1}'.encode("utf-16"), "can't decode"),
        ("json", b"[\xd9\xa1]", "Expecting value"),
        ("json", b"{} {}", "Extra data"),
        ("lines", LINE + b"{\n", "run.jsonl: line 2 is no measurement, Expecting property name enclosed"),
        ("lines", LINE + b"\n" + LINE, "value at character 1: restore the file, or run again"),
        (
            "lines",
            b'{"kind": "training"}\n',
            "run.jsonl: line 1: block, frames must be there: restore the file, or run again",
        ),
        ("lines", LINE + b'{"kind": "x", "kind": "y"}\n', "key 'kind' occurs twice in one object"),
        ("yaml", b"a: &x [1]\nb: [*x, *x]", "anchors (&name) are not read"),
        ("yaml", b"a: *x", "aliases (*name) are not read"),
        ("yaml", b"a: 1\na: 2", "key 'a' occurs twice"),
        ("yaml", b"<<: {a: 1}", "could not determine a constructor"),
        ("yaml", b"a: " + b":".join([b"59"] * 10**4), "is a number to some programs, a text to others"),
        ("yaml", b"a: 0x10", "is a number to some programs, a text to others"),
        ("yaml", b"a: 010", "is a number to some programs, a text to others"),
        ("yaml", b"a: 2001-01-01", "could not determine a constructor"),
        ("yaml", b"a: !!python/object/apply:os.system [ls]", "could not determine a constructor"),
        ("yaml", b"a: " + b"9" * 500, "too long"),
        ("yaml", b"[" * 200, "nested more than 32 deep"),
        ("yaml", b"a: \xff", "can't decode"),
        ("yaml", b"? [1]\n: 2", "a key must be a text or a number"),
    ],
)
def test_what_has_two_meanings_or_takes_too_much_is_refused(name, content, message):
    with pytest.raises(ValueError) as refused:
        READERS[name](content)

    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_line_that_is_whole_makes_no_message():
    class Silent(str):
        def __repr__(self) -> str:
            raise AssertionError("a message was made")

    check({"kind": Silent("training"), "block": 1, "frames": 64, "return_mean": 0.5})


def test_a_last_line_without_an_end_is_what_a_killed_run_leaves():
    log = RunLog.of_content(LINE + b'{"kind": "trai', "run.jsonl")

    assert (len(log.measurements), log.torn_lines) == (1, 1)


@pytest.mark.parametrize(
    "metrics",
    [[], {}, {"a": []}, {"a": "x"}, {"a": {"value": "1", "definition": "", "undefined": None}}, {"a": {"value": 1}}],
)
def test_what_are_no_metrics_is_refused(metrics):
    with pytest.raises(ValueError, match="it does not hold metrics of ours"):
        metrics_of(json.dumps(metrics).encode())


@pytest.mark.parametrize(
    ("number", "message"), [("1e101", "metrics of ours"), ("1" + "0" * 400, "401 digits"), ("[1]", "metrics of ours")]
)
def test_numbers_whose_sums_would_overflow_are_no_metrics(number, message):
    with pytest.raises(ValueError, match=message):
        metrics_of(f'{{"a": {{"value": {number}, "definition": "", "undefined": null}}}}'.encode())


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("versions", each) for each in (5, ["torch"], "torch", {"torch": 5})),
        *(("together", each) for each in (5, "0", ["0"], {})),
        *(("experts", each) for each in (5, {}, [5], [{}], [{"task": "1"}], [{"task": 1, "together": 5}])),
        *(("return_mean", each) for each in (1e308, -1e101, 10**400, [], "1")),
    ],
)
def test_a_field_of_another_type_is_refused_by_its_name(field, value):
    content = LINE + json.dumps({"kind": "other", field: value}).encode() + b"\n"

    with pytest.raises(ValueError, match=f"line 2.*({field} must be|401 digits)"):
        RunLog.of_content(content, "run.jsonl")


def test_files_are_found_in_folders_that_are_not_too_deep(tmp_path):
    (tmp_path / "a" / "b").mkdir(parents=True)
    for name in ("a/run.jsonl", "a/b/run.jsonl", "a/other"):
        (tmp_path / name).write_text("")
    deep = tmp_path.joinpath(*["x"] * 40)
    deep.mkdir(parents=True)
    (deep / "run.jsonl").write_text("")
    (tmp_path / "link").symlink_to(tmp_path / "a")

    files, refused = strict.files_below(tmp_path, ("run.jsonl",))

    assert files == [tmp_path / "a" / "b" / "run.jsonl", tmp_path / "a" / "run.jsonl"]
    assert refused == [tmp_path.joinpath(*["x"] * strict.MAX_DEPTH)]
    assert tmp_path / "link" in strict.files_below(tmp_path)[0]


def test_a_large_file_is_refused_by_its_size_and_another_is_not_read_as_a_whole(tmp_path):
    sparse = tmp_path / "sparse"
    with sparse.open("wb") as file:
        file.truncate(10 * 2**30)

    with pytest.raises(ValueError, match=r"sparse has 10,737,418,240 bytes, the limit is 1,000"):
        strict.sha256_of(sparse, 1000)
    (tmp_path / "empty").write_bytes(b"")
    assert strict.sha256_of(tmp_path / "empty", 0).startswith("e3b0c44298fc1c14")


def mangled(content: bytes, rng: random.Random) -> bytes:
    """Return a content with a few bytes changed, left out, repeated or added."""
    made = bytearray(content)
    for _ in range(rng.randint(1, 4)):
        at, how = rng.randrange(len(made) + 1), rng.randrange(4)
        if how == 0:
            made[at:at] = rng.choice([b'"', b"{", b"[", b"\n", b"&a ", b"*a", b":", b"9" * 60, b"\xff", b"NaN", b"\0"])
        elif how == 1:
            del made[at : at + rng.randint(1, 9)]
        elif how == 2:
            made[at:at] = made[at : at + rng.randint(1, 40)]
        elif at < len(made):
            made[at] = rng.randrange(256)
    return bytes(made)


def check_fuzzed(name: str, cases: range) -> None:
    """Read mangled contents: each is refused in one line, or read as something plain."""
    content = VALID[name]
    refused = 0
    for case in cases:
        try:
            value = READERS[name](mangled(content, random.Random(case)))
        except ValueError as error:
            assert "Traceback" not in str(error)
            refused += 1
        else:
            assert name not in ("json", "yaml") or is_plain(value)
    assert len(cases) / 5 < refused


def is_plain(value: Any) -> bool:
    if isinstance(value, dict):
        return all(map(is_plain, value.values()))
    if isinstance(value, list):
        return all(map(is_plain, value))
    return value is None or isinstance(value, str | bool | int) or not math.isnan(value)


@pytest.mark.parametrize("name", READERS)
def test_readers_raise_nothing_but_value_errors(name):
    check_fuzzed(name, range(50))


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_readers_raise_nothing_but_value_errors_in_800_cases(name):
    check_fuzzed(name, range(50, 850))
