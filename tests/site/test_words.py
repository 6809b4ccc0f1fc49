"""Words that stay out of pages, docstrings, comments, messages and help: metaphors that a reader has to guess."""

from __future__ import annotations

import io
import json
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

from helpers.paths import CHECKOUT, sources

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

FOLDERS = ("ctgraph_rl", "baselines", "curricula", "hydra_plugins", "conf", "docs")
FILES = ("README.md", "CONTRIBUTING.md", "SECURITY.md")
KINDS = (".py", ".md", ".ipynb", ".yaml", ".j2", ".c")

TOKENS = {tokenize.STRING, tokenize.COMMENT, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)}
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
    """The words that a file should not have, each with what is around it."""
    name = path.relative_to(CHECKOUT).as_posix()
    return [
        f"{name}: ...{text[max(0, match.start() - 60) : match.end() + 30]}...".replace("\n", " ")
        for text in texts(path)
        for match in WORDS.finditer(text)
        if not any(name == file and words in text for file, words in ALLOWED.items())
    ]


def test_the_words_that_stay_out_are_in_no_page_docstring_comment_or_message():
    files = shown()

    assert len(files) > 250
    assert [line for path in files for line in found(path)] == []


def test_a_word_is_found_in_docstrings_comments_and_messages_and_not_in_names(tmp_path):
    code = 'def told(luck):\n    """Told."""\n    # anew\n    raise ValueError(f"{luck} goes on")\n'
    path = tmp_path / "module.py"
    path.write_text(code)

    hits = [match.group() for text in texts(path) for match in WORDS.finditer(text.replace("{luck}", ""))]

    assert hits == ["Told", "anew", "goes on"]
