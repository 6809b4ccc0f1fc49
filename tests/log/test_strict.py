"""Files of strangers: what has two meanings is refused in one line, and so is what takes more than its file says."""

from __future__ import annotations

import gzip
import json
import math
import random
from collections.abc import Callable
from typing import Any

import pytest
import yaml

from ctgraph_rl import strict
from ctgraph_rl.log.damage import metrics_of
from ctgraph_rl.log.run_log import RunLog

LINE = b'{"kind": "run", "curriculum": "a", "config": {"seed": 0}}\n'

VALID: dict[str, bytes] = {
    "json": json.dumps({"a": [1, -2.5e-3, None, True, "x\u00e9"], "b": {"c": {}}}, indent=2).encode(),
    "lines": LINE + b'{"kind": "training", "block": 1, "frames": 64, "return_mean": 0.5}\n' * 2,
    "yaml": yaml.safe_dump({"name": "x", "seeds": [1, 2], "hours": 0.5, "none": None, "part": {"yes": True}}).encode(),
    "csv": b'run,metric,value\na,one,1\na,two,"x,""y"""\n',
    "gzip": gzip.compress(LINE * 20, mtime=0),
}

READERS: dict[str, Callable[[bytes], Any]] = {
    "json": strict.json_value,
    "lines": lambda content: RunLog.of_content(content, "run.jsonl").measurements,
    "yaml": strict.yaml_value,
    "csv": lambda content: strict.csv_rows(content, ["run", "metric", "value"], ["run", "metric"], 3),
    "gzip": lambda content: strict.unpacked(content, 10**5),
    "parquet": lambda content: strict.parquet_rows(content, table()),
}


def table(rows: int = 3, **columns: Any) -> bytes:
    """Return a Parquet file with a text and a number in each row."""
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import BufferOutputStream, parquet

    options = columns.pop("options", {})
    made = BufferOutputStream()
    whole = {"label": [f"goal {row}" for row in range(rows)], "frames": [64 * row for row in range(rows)], **columns}
    parquet.write_table(pyarrow.table(whole), made, **options)
    return made.getvalue().to_pybytes()


@pytest.mark.parametrize("name", VALID)
def test_what_is_whole_is_read(name):
    read = READERS[name](VALID[name])

    assert read
    if name == "json":
        assert read == json.loads(VALID[name])
    if name == "yaml":
        assert read == yaml.safe_load(VALID[name])
    if name == "gzip":
        assert read == LINE * 20


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
        ("lines", LINE + b"{\n", "run.jsonl: line 2 is no measurement; restore the file"),
        ("lines", LINE + b"\n" + LINE, "run.jsonl: line 2 is no measurement; restore the file"),
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
        ("csv", b"run,metric,value\na,one,0.99\na,one,0.1\n", "lines 2 and 3 are both of a, one: leave one out"),
        ("csv", b"run,metric,value\n" + b"a,one,1\n" * 4, "has more than 3 rows, the limit"),
        ("csv", b"run,metric,value\ra,one,1\r", "must end lines with a line feed"),
        ("csv", b"run,value,metric\n", "must have the columns run, metric, value, got run, value, metric"),
        ("csv", b"run,metric,value\na,one\n", "must have 3 cells in every line, line 2 has others"),
        ("csv", b'run,metric,value\na,"one', "must be CSV"),
        ("csv", b"run,metric,value\na,\xff,1\n", "can't decode"),
        ("gzip", VALID["gzip"] + gzip.compress(b"more"), "has more after its end"),
        ("gzip", VALID["gzip"] + b"\0", "has more after its end"),
        ("gzip", VALID["gzip"][:-1], "ends too early"),
        ("gzip", gzip.compress(bytes(10**6)), "holds more than 100,000 bytes"),
        ("gzip", b"x" * 20, "is no file of gzip"),
    ],
)
def test_what_has_two_meanings_or_takes_too_much_is_refused(name, content, message):
    with pytest.raises(ValueError) as refused:
        READERS[name](content)

    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_file_of_gzip_holds_no_more_than_its_size_lets_expect(monkeypatch):
    content = gzip.compress(bytes(10**5), mtime=0)
    assert strict.unpacked(content, 10**6) == bytes(10**5)
    monkeypatch.setattr(strict, "LEAST_UNPACKED", 1000)

    with pytest.raises(ValueError, match=f"holds more than {1000 + 50 * len(content):,} bytes, the limit"):
        strict.unpacked(content, 10**6)


def test_a_last_line_without_an_end_is_what_a_killed_run_leaves():
    log = RunLog.of_content(LINE + b'{"kind": "trai', "run.jsonl")

    assert (len(log.measurements), log.torn_lines) == (1, 1)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"rows": 4}, "it has 4 rows, the logs give 3"),
        ({"frames": [0.0, 1.0, 2.0]}, "it has the columns label BYTE_ARRAY, frames DOUBLE"),
        ({"frames": [[1] * 1000] * 3}, "it has the columns"),
        ({"more": [1, 2, 3]}, "it has the columns"),
        ({"options": {"compression": "gzip"}}, "its compression must be one of SNAPPY, UNCOMPRESSED"),
        ({"label": ["x" * 2**17] * 3}, "a text in label has 131,072 bytes, the limit is 65,536"),
        ({"label": [random.Random(0).randbytes(2**20).hex()] * 3}, "1,048,960 are enough for its rows"),
    ],
)
def test_a_table_of_another_form_is_refused_before_it_is_unpacked(columns, message):
    with pytest.raises(ValueError) as refused:
        READERS["parquet"](table(**columns))

    assert message in str(refused.value)


@pytest.mark.parametrize("rows", [0, 3, 5000])
def test_a_table_of_the_right_form_is_read(rows):
    content = table(rows)

    assert strict.parquet_rows(content, content) == [{"label": f"goal {i}", "frames": 64 * i} for i in range(rows)]


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
    content = VALID[name] if name != "parquet" else table()
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


def test_a_parquet_file_of_an_unknown_compression_is_refused_and_does_not_end_the_process():
    with pytest.raises(ValueError, match="its compression is unknown"):
        READERS["parquet"](mangled(table(), random.Random(1111)))


@pytest.mark.parametrize("name", READERS)
def test_readers_raise_nothing_but_value_errors(name):
    check_fuzzed(name, range(50))


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_readers_raise_nothing_but_value_errors_in_800_cases(name):
    check_fuzzed(name, range(50, 850))
