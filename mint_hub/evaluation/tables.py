"""Results as tables: for Markdown and for the report, ours and the published ones apart."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isnan
from pathlib import Path
from typing import Any, Final

from mint_hub.evaluation.published import HEADING, PublishedTable, published_tables
from mint_hub.evaluation.results import Results
from mint_hub.evaluation.scoring import ALIGNMENTS
from mint_hub.evaluation.summary import Triple
from mint_hub.geometry.metrics import (
    FIELD_OF_VIEW,
    HAND_MEASURES,
    NOTHING,
    WORLD_MEASURES,
    interval,
    measure_of,
    number,
)
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.derived import markdown_table

PUBLISHED_HAND_MEASURES: Final = HAND_MEASURES[:9]
CAMERA_COLUMNS: Final = (
    *("RPE-T mean", "RPE-T median", "RPE-R mean", "RPE-R median"),
    "Arc-length ratio (predicted / true) mean",
)
DRIFT_COLUMNS: Final = (
    *("ATE mean", "ATE % mean", "RPE-T 1 s mean", "RPE-R 1 s mean", "|log scale| 1 s median"),
    *("ATE 10 s mean", "ATE 1 min mean", "ATE 10 min mean"),
)
SIM3_COLUMNS: Final = ("ATE", "ATE %", "RPE-T", "RPE-T 1 s", "ATE 10 s", "ATE 1 min", "ATE 10 min")


@dataclass(frozen=True)
class Cell:
    """A number as text, its interval as text, and the number."""

    text: str
    interval: str = ""
    value: float = float("nan")


@dataclass(frozen=True)
class Table:
    """Rows of cells under columns; a row is "ours", "trivial" or "published"."""

    title: str
    note: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[Cell, ...]], ...]
    kinds: tuple[str, ...]

    def markdown(self) -> str:
        """The table under its title."""
        cells = [
            (name, *(f"{c.text} {c.interval}".strip() for c in row)) for name, row in self.rows
        ]
        note = f"{self.note}\n\n" if self.note else ""
        return f"### {self.title}\n\n{note}{markdown_table(('', *self.columns), cells)}"

    def text(self) -> str:
        """The table for a terminal: turned, a line a number, a column a row."""
        grid = [(self.title, *(name for name, _ in self.rows))]
        for k, column in enumerate(self.columns):
            cells = [row[k] for _, row in self.rows]
            grid.append((column, *(f"{c.text} {c.interval}".strip() for c in cells)))
        wide = [max(map(len, cells)) for cells in zip(*grid, strict=True)]
        lines = (
            "  ".join(cell.ljust(size) for cell, size in zip(line, wide, strict=True)).rstrip()
            for line in grid
        )
        return "\n".join(lines) + "\n"


def cell(triple: Triple | None, unit: str) -> Cell:
    """A value with its interval where there is one."""
    if triple is None or isnan(triple[0]):
        return Cell(NOTHING)
    value, low, high = triple
    return Cell(number(value, unit), interval(low, high, unit), value)


def all_tables(results: Results) -> list[Table]:
    """Return our tables, in the order in which they are read."""
    made = [
        *_hands(results),
        _readings(results),
        *_camera(results),
        _camera_sim3(results),
        *(_world(results, alignment) for alignment in ALIGNMENTS),
        _strata(results),
    ]
    return [table for table in made if table.rows]


def main_tables(results: Results) -> list[Table]:
    """Return the tables to look at first: hands and camera, as predicted."""
    return [table for table in (*_hands(results), *_camera(results)) if table.rows]


def published(results: Results) -> list[tuple[Table, PublishedTable]]:
    """Return the paper's tables of the same benchmark, each with where it stands."""
    name = results.benchmark["published"]
    found = published_tables(name) if name else {}
    made: list[tuple[Table, PublishedTable]] = []
    for table in found.values():
        rows = tuple(
            (
                method,
                tuple(Cell(f"{value:g}", value=value) for value in row),
            )
            for method, row in table.rows
        )
        columns = tuple(measure_of(c).title for c in table.columns)
        title = f"{table.title}: {HEADING.lower()}"
        note = f"Source: {table.source}. {table.note}".strip()
        made.append((Table(title, note, columns, rows, ("published",) * len(rows)), table))
    return made


def write_markdown(results: Results, path: Path) -> Path:
    """Write every table, the published ones under a heading of their own."""
    facts = results.benchmark
    about = f"{facts['clips']} clips, {facts['frames']} frames, hash {facts['hash']}"
    who = results.prediction["name"] if results.prediction else "trivial rows alone"
    parts = [
        f"# {facts['title']}: {who}",
        f"{about}. mint-hub {results.mint_hub}, {results.date}. In brackets: 95 % of a bootstrap "
        f"over recordings. Mean hand: of {results.trained_on}.",
        *(f"- {text}" for text in (*facts["notes"], *results.warnings)),
        *(table.markdown() for table in all_tables(results)),
    ]
    if results.efficiency:
        parts.append("### Efficiency\n\n" + efficiency_line(results.efficiency))
    if theirs := published(results):
        parts.append(f"## {HEADING}\n\nCopied from their source, to read beside ours.")
        parts += [table.markdown() for table, _ in theirs]
    with replacing(path) as temporary:
        temporary.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    return path


def efficiency_line(facts: Mapping[str, Any]) -> str:
    """Speed and memory in a sentence."""
    memory = facts["peak_memory_bytes"] / 2**30
    count = facts.get("processes", 1)
    shared = "" if count == 1 else f" in each of {count} processes side by side"
    return (
        f"{facts['ms_a_frame']:.1f} ms a frame ({facts['frames_a_second']:.1f} frames/s){shared}, "
        f"over {facts['frames']} frames after warm-up, from decoded pictures to the fused episode; "
        f"peak memory {memory:.2f} GiB; {facts['device']}, {facts['dtype']}, window "
        f"{facts['window']}, overlap {facts['overlap']}, batch {facts['batch_size']}."
    )


# ------------------------------------------------------------------------- each table


def _table(
    results: Results, title: str, note: str, columns: Sequence[str], numbers: Mapping[str, Any]
) -> Table:
    """``numbers`` is a mapping of triples by column for each row that has any.

    A column without a number in any row is left out (drift over 10 minutes, of short clips), unless
    no column has one.
    """
    filled = [
        c
        for c in columns
        if any(cell(found.get(c), "").text != NOTHING for found in numbers.values())
    ]
    columns = filled or columns
    rows = tuple(
        (results.title(r), tuple(cell(found.get(c), measure_of(c).unit) for c in columns))
        for r, found in numbers.items()
        if found
    )
    kinds = tuple(
        "ours" if r == "prediction" else "trivial" for r, found in numbers.items() if found
    )
    return Table(title, note, tuple(measure_of(c).title for c in columns), rows, kinds)


def _hands(results: Results) -> tuple[Table, Table]:
    numbers = {r: s["hands"].get("published", {}) for r, s in results.summary.items()}
    theirs = _table(
        results,
        "Hands in the camera frame",
        "As the paper's tables are made: false alarms on hands off screen cost nothing.",
        [m.name for m in PUBLISHED_HAND_MEASURES],
        numbers,
    )
    ours = _table(
        results,
        "Hands in the camera frame: beyond the paper's protocol",
        "False alarms off screen count in Presence-BA; CT-p is split along and across the viewing "
        "ray; jitter stands beside the truth's, and less than it is negative.",
        [m.name for m in HAND_MEASURES if m not in PUBLISHED_HAND_MEASURES],
        numbers,
    )
    return theirs, ours


def _readings(results: Results) -> Table:
    names = ("EPE-p", "CT-p", "CT-along-p", "CT-lateral-p")
    columns: list[str] = []
    numbers: dict[str, dict[str, Any]] = {}
    for row, summary in results.summary.items():
        found: dict[str, Any] = {}
        for name in names:
            for reading, triples in summary["hands"].items():
                if name.startswith("CT-") and reading == "predicted":
                    continue  # K only matters where something is projected
                found[f"{name}, {reading}"] = triples[name]
        if found:
            numbers[row] = {**found, FIELD_OF_VIEW.name: summary["fov_error_deg"]}
            columns = list(numbers[row])
    return _table(
        results,
        "Hands by what is known of the camera",
        "published: as predicted, projected with the true intrinsics; predicted: with the "
        "predicted ones; known: wrists placed under the true focal length.",
        columns,
        numbers,
    )


def _camera(results: Results) -> tuple[Table, Table]:
    numbers, cut = {r: s["camera"] for r, s in results.summary.items()}, _cut_note(results)
    step = _table(
        results,
        "Camera path, SE(3) alignment",
        f"From frame to frame, as the paper's tables are made; over clips that move.{cut}",
        CAMERA_COLUMNS,
        numbers,
    )
    drift = _table(
        results,
        "Camera path, SE(3) alignment: scale and drift",
        f"ATE over a stretch of time is with a fit in every such stretch.{cut}",
        DRIFT_COLUMNS,
        numbers,
    )
    return step, drift


def _cut_note(results: Results) -> str:
    """What to know of camera numbers of sequences that were cut."""
    frames = results.benchmark.get("clip_frames")
    if frames is None:
        return ""
    return (
        f" Each window of {frames} frames is a path of its own here, with an alignment of its own; "
        "published camera numbers are of whole sequences: to read beside them, evaluate without "
        "--clip-frames."
    )


def _camera_sim3(results: Results) -> Table:
    numbers = {
        r: {f"{c} mean": s["camera"].get(f"{c}, Sim(3) mean") for c in SIM3_COLUMNS}
        for r, s in results.summary.items()
        if s["camera"]
    }
    columns = [f"{c} mean" for c in SIM3_COLUMNS]
    note = "The prediction is scaled to the truth first: shape without scale."
    note += _cut_note(results)
    return _table(results, "Camera path, Sim(3) alignment", note, columns, numbers)


def _world(results: Results, alignment: str) -> Table:
    numbers = {r: s["world"].get(alignment, {}) for r, s in results.summary.items()}
    return _table(
        results,
        f"Hands in the world, camera path aligned by {alignment}",
        "Where both sides have the hand; coverage says how much of the truth that is."
        if alignment == ALIGNMENTS[0]
        else "",
        [m.name for m in WORLD_MEASURES],
        numbers,
    )


def _bins(strata: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Bins in order, without those of a stratum that has one only: they are the whole."""
    kinds = [name.partition(": ")[0] for name in strata]
    several = [item for item in strata.items() if kinds.count(item[0].partition(": ")[0]) > 1]
    return sorted(several, key=_bin_order)


def _bin_order(item: tuple[str, Any]) -> tuple[str, float, str]:
    kind, _, label = item[0].partition(": ")
    first = label.split()[0]
    return kind, float(first) if first.replace(".", "").isdigit() else 0.0, label


def _strata(results: Results) -> Table:
    """Every bin with the numbers of each row that has hands of its own."""
    names = ("Recall", "F1", "MPJPE-p", "PA-MPJPE-p", "EPE-p", "GO-p", "CT-p")
    rows: list[tuple[str, tuple[Cell, ...]]] = []
    kinds: list[str] = []
    by_row = {r: s["strata"] for r, s in results.summary.items() if s["strata"]}
    for bin_name, _ in _bins(next(iter(by_row.values()), {})):
        for row, strata in by_row.items():
            found = strata[bin_name]
            cells = [Cell(number(found[n], measure_of(n).unit), value=found[n]) for n in names]
            title = f"{bin_name} · {results.title(row)}"
            rows.append((title, (Cell(f"{found['hands']:,}"), *cells)))
            kinds.append("ours" if row == "prediction" else "trivial")
    heads = ("hands", *(measure_of(n).title for n in names))
    return Table("By stratum", "", heads, tuple(rows), tuple(kinds))
