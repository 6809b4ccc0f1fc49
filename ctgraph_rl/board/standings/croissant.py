"""Metadata of the board's data in Croissant 1.0 (https://docs.mlcommons.org/croissant/docs/croissant-spec.html)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from datetime import date
from pathlib import Path

from ctgraph_rl import __version__
from ctgraph_rl.checks import NamedValues

CONTEXT = json.loads(Path(__file__).with_name("croissant_context.json").read_text(encoding="utf-8"))
"""The names that the specification fixes."""

LICENCE = "https://spdx.org/licenses/Apache-2.0.html"
URL = "https://arxiv.org/abs/2302.10887"
CREATOR = "The ctgraph_rl developers, and the authors of the submissions"

Columns = Mapping[str, tuple[str, str]]
"""Types and meanings by the names of columns."""


def croissant(files: Mapping[str, tuple[str, Columns]], key: str, published: date) -> NamedValues:
    """Return the metadata of CSV files that stand beside it.

    Args:
        files: content and columns of each file, by its name; the first one has a line for each value of ``key``.
        key: a column of all files; those of the others refer to the first one's.
        published: the day of publication.
    """
    first = next(iter(files))
    return {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": "ctgraph_rl_board",
        "description": "Submissions to the tracks of the CT-graph benchmark, with the scores of each seed.",
        "license": LICENCE,
        "url": URL,
        "creator": {"@type": "Organization", "name": CREATOR},
        "datePublished": published.isoformat(),
        "version": __version__,
        "distribution": [_file(name, content) for name, (content, _) in files.items()],
        "recordSet": [_records(name, columns, key, first) for name, (_, columns) in files.items()],
    }


def _file(name: str, content: str) -> NamedValues:
    """Return a file with its sum."""
    data = content.encode()
    return {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name,
        "contentUrl": name,
        "contentSize": f"{len(data)} B",
        "encodingFormat": "text/csv",
        "sha256": hashlib.sha256(data).hexdigest(),
    }


def _records(name: str, columns: Columns, key: str, first: str) -> NamedValues:
    """Return the records of a file, with a field for each column."""
    records = name.partition(".")[0]
    home = first.partition(".")[0]
    fields = []
    for column, (kind, meaning) in columns.items():
        own: NamedValues = {
            "@type": "cr:Field",
            "@id": f"{records}/{column}",
            "name": column,
            "description": meaning,
            "dataType": kind,
            "source": {"fileObject": {"@id": name}, "extract": {"column": column}},
        }
        if column == key and name != first:
            own["references"] = {"field": {"@id": f"{home}/{key}"}}
        fields.append(own)
    unique = {"key": {"@id": f"{records}/{key}"}} if name == first else {}
    return {"@type": "cr:RecordSet", "@id": records, "name": records, **unique, "field": fields}
