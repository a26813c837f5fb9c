"""Results as tables: for Markdown and for the report, ours and the published ones apart."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isnan
from pathlib import Path
from typing import Any, Final

from mint_hub.evaluation.published import HEADING, PublishedTable, published_tables
from mint_hub.evaluation.results import Results, Triple
from mint_hub.evaluation.scoring import ALIGNMENTS
from mint_hub.geometry.metrics import (
    HAND_MEASURES,
    TRAJECTORY_MEASURES,
    WORLD_MEASURES,
    Measure,
)
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.derived import markdown_table

DIGITS: Final = {
    "": 3,
    "mm": 2,
    "px": 1,
    "deg": 2,
    "m": 3,
    "mm/frame^2": 2,
    "% of path": 2,
    "m/s^2": 2,
}
NOTHING: Final = "—"
CAMERA_COLUMNS: Final = (
    *("RPE-T mean", "RPE-T median", "RPE-R mean", "RPE-R median"),
    "Arc-length ratio (predicted / true) mean",
    *("ATE mean", "ATE % mean", "RPE-T 1 s mean", "RPE-R 1 s mean", "|log scale| 1 s median"),
    *("ATE 10 s mean", "ATE 1 min mean", "ATE 10 min mean"),
)
SIM3_COLUMNS: Final = ("ATE", "ATE %", "RPE-T", "RPE-T 1 s", "ATE 10 s", "ATE 1 min", "ATE 10 min")
_BY_NAME: Final = {m.name: m for m in (*HAND_MEASURES, *TRAJECTORY_MEASURES, *WORLD_MEASURES)}


@dataclass(frozen=True)
class Cell:
    """A number as text, its interval as text, and the number."""

    text: str
    interval: str = ""
    value: float = float("nan")


@dataclass(frozen=True)
class Table:
    """Rows of cells under columns; a row is "ours", "trivial", "published" or "stratum"."""

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


def measure_of(column: str) -> Measure:
    """What a column's number is, whichever statistic of it over clips."""
    name = column.removesuffix(" mean").removesuffix(" median")
    return _BY_NAME.get(name, Measure(name, "", None))


def number(value: float, unit: str) -> str:
    """A number with the digits of its unit.

    >>> number(29.9264, "mm"), number(float("nan"), "mm")
    ('29.93', '—')
    """
    return NOTHING if isnan(value) else f"{value:.{DIGITS.get(unit, 3)}f}"


def cell(triple: Triple | None, unit: str) -> Cell:
    """A value with its interval where there is one."""
    if triple is None or isnan(triple[0]):
        return Cell(NOTHING)
    value, low, high = triple
    interval = "" if isnan(low) else f"[{number(low, unit)}, {number(high, unit)}]"
    return Cell(number(value, unit), interval, value)


def all_tables(results: Results) -> list[Table]:
    """Return our tables, in the order in which they are read."""
    made = [
        _hands(results),
        _readings(results),
        _camera(results),
        _camera_sim3(results),
        *(_world(results, alignment) for alignment in ALIGNMENTS),
        _strata(results),
    ]
    return [table for table in made if table.rows]


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
        columns = tuple(_head(c) for c in table.columns)
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
        f"over clips. Mean hand: of {results.trained_on}.",
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
    return (
        f"{facts['ms_a_frame']:.1f} ms a frame ({facts['frames_a_second']:.1f} frames/s) over "
        f"{facts['frames']} frames after warm-up, from decoded pictures to the fused episode; "
        f"peak memory {memory:.2f} GiB; {facts['device']}, {facts['dtype']}, window "
        f"{facts['window']}, overlap {facts['overlap']}, batch {facts['batch_size']}."
    )


# ------------------------------------------------------------------------- each table


def _head(column: str) -> str:
    unit = measure_of(column).unit
    return f"{column} ({unit})" if unit else column


def _table(
    results: Results, title: str, note: str, columns: Sequence[str], numbers: Mapping[str, Any]
) -> Table:
    """``numbers`` is a mapping of triples by column for each row that has any."""
    rows = tuple(
        (results.title(r), tuple(cell(found.get(c), measure_of(c).unit) for c in columns))
        for r, found in numbers.items()
        if found
    )
    kinds = tuple(
        "ours" if r == "prediction" else "trivial" for r, found in numbers.items() if found
    )
    return Table(title, note, tuple(_head(c) for c in columns), rows, kinds)


def _hands(results: Results) -> Table:
    numbers = {r: s["hands"].get("published", {}) for r, s in results.summary.items()}
    return _table(
        results,
        "Hands in the camera frame",
        "As the paper's tables are made. The last four are ours: false alarms off screen count in "
        "Presence-BA; CT-p is split along and across the viewing ray; jitter stands beside the "
        "truth's.",
        [m.name for m in HAND_MEASURES],
        numbers,
    )


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
            numbers[row] = {**found, "field of view error": summary["fov_error_deg"]}
            columns = list(numbers[row])
    rows = tuple(
        (
            results.title(row),
            tuple(
                cell(found.get(c), measure_of(c.partition(",")[0]).unit or "deg") for c in columns
            ),
        )
        for row, found in numbers.items()
    )
    kinds = tuple("ours" if row == "prediction" else "trivial" for row in numbers)
    heads = tuple(f"{c} ({measure_of(c.partition(',')[0]).unit or 'deg'})" for c in columns)
    return Table(
        "Hands by what is known of the camera",
        "published: as predicted, projected with the true intrinsics; predicted: with the "
        "predicted ones; known: wrists placed under the true focal length.",
        heads,
        rows,
        kinds,
    )


def _camera(results: Results) -> Table:
    numbers = {r: s["camera"] for r, s in results.summary.items()}
    return _table(
        results,
        "Camera path, SE(3) alignment",
        "Over clips that move; ATE 10 s to 10 min is drift: a fit in every such stretch.",
        CAMERA_COLUMNS,
        numbers,
    )


def _camera_sim3(results: Results) -> Table:
    numbers = {
        r: {f"{c} mean": s["camera"].get(f"{c}, Sim(3) mean") for c in SIM3_COLUMNS}
        for r, s in results.summary.items()
        if s["camera"]
    }
    columns = [f"{c} mean" for c in SIM3_COLUMNS]
    note = "The prediction is scaled to the truth first: shape without scale."
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


def _bin_order(item: tuple[str, Any]) -> tuple[str, float, str]:
    kind, _, label = item[0].partition(": ")
    first = label.split()[0]
    return kind, float(first) if first.replace(".", "").isdigit() else 0.0, label


def _strata(results: Results) -> Table:
    """The first row's numbers by bin."""
    if not results.rows:
        return Table("", "", (), (), ())
    row = results.rows[0]
    names = ("Recall", "F1", "MPJPE-p", "PA-MPJPE-p", "EPE-p", "GO-p", "CT-p")
    rows = tuple(
        (
            name,
            (
                Cell(f"{found['hands']:,}"),
                *(Cell(number(found[n], measure_of(n).unit), value=found[n]) for n in names),
            ),
        )
        for name, found in sorted(results.summary[row]["strata"].items(), key=_bin_order)
    )
    heads = ("hands", *(_head(n) for n in names))
    return Table(f"By stratum: {results.title(row)}", "", heads, rows, ("stratum",) * len(rows))
