"""Numbers that others published, as data with their source; never ours, never run here."""

import json
from dataclasses import dataclass
from typing import Any, Final

from mint_hub.assets import read_asset

FILE: Final = "published.json"
HEADING: Final = "Published numbers (not run here)"


@dataclass(frozen=True)
class PublishedTable:
    """One table of a paper.

    Attributes:
        title: what it is of.
        source: where it stands.
        note: what to know before comparing.
        columns: names of its numbers, as ours where they mean the same.
        rows: method and its numbers.

    """

    title: str
    source: str
    note: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[float, ...]], ...]


def published_tables(benchmark: str | None = None) -> dict[str, PublishedTable]:
    """Tables by "benchmark kind" ("hot3d hands"), of one benchmark or of all.

    Raises:
        ValueError: the file is damaged: a row has another number of values than there are columns.

    """
    found: dict[str, PublishedTable] = {}
    values: dict[str, Any] = json.loads(read_asset(FILE))
    for key, table in values["tables"].items():
        if benchmark is not None and not key.startswith(f"{benchmark} "):
            continue
        columns = tuple(table["columns"])
        rows = tuple((str(name), tuple(map(float, row))) for name, row in table["rows"])
        for name, row in rows:
            if len(row) != len(columns):
                raise ValueError(
                    f"{FILE}, {key}, {name}: expected {len(columns)} numbers, got {len(row)}"
                )
        source = values["sources"][table["source"]]
        found[key] = PublishedTable(table["title"], source, table["note"], columns, rows)
    return found
