"""Words that stay out of pages, docstrings, comments, messages and help: metaphors that a reader has to guess."""

from __future__ import annotations

import io
import json
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.paths import CHECKOUT, sources

from ctgraph_rl import cli, parsers

INSTEAD = {
    r"wears?|wearing|worn": "a method is used with an agent, as in PPO trained with EWC",
    r"anew": "again, or new",
    r"luck|lucky|luckily|unlucky": "by chance; under a random policy",
    r"go on|goes on|going on|gone on|went on": "resume, continue",
    r"told": "the learner observes, the agent is informed; tasks are distinguished",
    r"nobody|whoever": "no one; any policy that ...",
    r"strangers?": "files of other people",
    r"out comes?": "is the result; is measured",
    r"(?:that|which) (?:is|are) none": "is not a ...",
    r"go(?:es)? over to": "changes to",
    r"(?:EWC|MAS|SI|CLEAR|PackNet) x (?:PPO|A2C|DQN)": "PPO trained with EWC",
}
"""Words, as regular expressions that ignore case, and what to write instead."""

ALLOWED: dict[str, str] = {}
"""Texts in which a word is right, by the file that has them."""

SENTENCES = {
    r"so do(?:es)?": "name who does what",
    r"something else (?:than|in)": "differs from",
    r"of (?:its|their) own": "separate; another",
    r"as (?:it is|they are)": "unchanged",
    r"alone": "only; without others",
    r"(?-i:(?:^|(?<=^- )|(?<=[.:!] ))(?:What|That (?:the|a|no|each|this|it)) (?:[^?|\]\n]|\n(?!\n))*?\.(?=\s|$))": (
        "subject, verb, object"
    ),
    r"says? so": "repeat what it says",
    r"in vain": "without success",
    r"and the like": "name them all, or one as an example",
    r"on purpose": "leave it out",
    r"(?:some|any)body": "you; others",
    r"an? \w+ of (?:yours|mine|ours)": "your ...",
    r"as any other(?: \w+)?": "leave it out, or say what is equal",
    r"(?-i:(?:^|(?<=^- )|(?<=[.!] ))(?:How|Whether|Why) (?:[^?|\]\n]|\n(?!\n))*?\.(?=\s|$))": "subject, verb, object",
}
"""Turns of phrase of a text that reads as if translated, and what to write instead."""

STORED = (
    "it is known of CT-graphs alone",
    "no labels of its own: it has no detector",
    "needs tasks trained alone, block",
    "around a training of one task alone",
    "needs each task trained once, alone,",
)
"""Reasons of undefined metrics, which stay: stored submissions hold them."""

FOLDERS = ("ctgraph_rl", "baselines", "benchmarks", "curricula", "hydra_plugins", "conf", "docs")
FILES = ("README.md", "CONTRIBUTING.md", "SECURITY.md")
KINDS = (".py", ".md", ".ipynb", ".yaml", ".j2", ".c")

TOKENS = {tokenize.STRING, tokenize.COMMENT, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)}
TURNS = re.compile(rf"\b(?:{'|'.join(SENTENCES)})(?!\w)", re.IGNORECASE | re.MULTILINE)
PLACEHOLDER = re.compile(r"\{[^{}]*\}")
CODE = re.compile(r"^```.*?^```$|`[^`\n]+`", re.DOTALL | re.MULTILINE)
WORDS = re.compile(rf"\b(?:{'|'.join(INSTEAD)})\b", re.IGNORECASE)


def texts(path: Path) -> Iterator[str]:
    """The prose of a file: docstrings, comments and messages of Python, cells of a notebook, all of anything else."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        tokens = tokenize.generate_tokens(io.StringIO(text).readline)
        yield from (token.string for token in tokens if token.type in TOKENS)
    elif path.suffix == ".ipynb":
        yield from ("".join(cell["source"]) for cell in json.loads(text)["cells"])
    else:
        yield text


def shown() -> list[Path]:
    """Files of the checkout that readers and users see."""
    paths = [(path, path.relative_to(CHECKOUT).parts) for path in sources(KINDS)]
    seen = [path for path, parts in paths if parts[0] in FOLDERS + FILES]
    return [path for path in seen if path.parent.name not in ("results", "templates")]


def found(path: Path) -> list[str]:
    """The words that a file should not have, each with what is around it, and in code the turns of phrase."""
    name = path.relative_to(CHECKOUT).as_posix()
    parts = list(texts(path))
    words = [
        f"{name}: ...{text[max(0, match.start() - 60) : match.end() + 30]}...".replace("\n", " ")
        for text in parts
        for match in WORDS.finditer(text)
        if not any(name == file and words in text for file, words in ALLOWED.items())
    ]
    if path.suffix != ".py" or name.startswith("docs/"):
        return words
    return words + [
        f"{name}: {turn}"
        for text in parts
        for turn in turns(PLACEHOLDER.sub("", text))
        if not any(reason in text for reason in STORED)
    ]


def test_words_and_turns_that_stay_out_are_in_no_page_docstring_comment_help_or_message():
    files = shown()

    assert len(files) > 250
    assert [line for path in files for line in found(path)] == []


def test_a_word_is_found_in_docstrings_comments_and_messages_and_not_in_names(tmp_path):
    code = 'def told(luck):\n    """Told."""\n    # anew\n    raise ValueError(f"{luck} goes on")\n'
    path = tmp_path / "module.py"
    path.write_text(code)

    hits = [match.group() for text in texts(path) for match in WORDS.finditer(text.replace("{luck}", ""))]

    assert hits == ["Told", "anew", "goes on"]


def turns(text: str) -> list[str]:
    """The turns of phrase that prose should not have; code is no prose."""
    return [match.group() for match in TURNS.finditer(CODE.sub("``", text))]


def test_pages_name_who_does_what():
    pages = [*shown(), *(CHECKOUT / "docs" / "results").glob("*.md")]
    named = {path.relative_to(CHECKOUT).as_posix(): path for path in pages if path.suffix in (".md", ".ipynb", ".yaml")}
    prose = {name: "\n".join(texts(path)) for name, path in named.items()}

    assert len(prose) > 150
    hits = {name: turns(text) for name, text in prose.items()}
    assert {name: each for name, each in hits.items() if each} == {}


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("It waits, and so does the other.", ["so does"]),
        ("A row has a seed of its own.", ["of its own"]),
        ("It stays as it is. A learner alone.", ["as it is", "alone"]),
        ("What cannot be composed is refused.", ["What cannot be composed is refused."]),
        ("Rows differ. That no row ends is rare.", ["That no row ends is rare."]),
        ("What memory buys\n\n`alone` What is a frame? It says what changed.", []),
        ("Files differ. Whether they matter is unknown.", ["Whether they matter is unknown."]),
        ("A reward of yours fails in vain, and the log says so.", ["A reward of yours", "in vain", "says so"]),
        ("How to stop\n\nMeasures: How deep a goal can be.", []),
    ],
)
def test_a_turn_of_phrase_is_found_in_prose_and_not_in_code_headings_or_questions(text, found):
    assert turns(text) == found


def test_help_has_no_backticks():
    files = [path.read_text(encoding="utf-8") for path in shown() if path.suffix == ".py"]
    helps = {name: make().format_help() for name in cli.COMMANDS if (make := getattr(parsers, name, None))}
    options = [line for text in files for line in re.findall(r'help=f?"[^"]*`', text)]

    assert len(helps) == 11
    assert [name for name, text in helps.items() if "`" in text] == options == []
