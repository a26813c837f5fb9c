"""Results as files: JSON, Markdown, pictures, and one page that opens offline."""

import base64
import html
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from math import isnan
from pathlib import Path
from typing import Final

from mint_hub.evaluation.benchmarks import open_benchmark
from mint_hub.evaluation.clips import Clip, Source
from mint_hub.evaluation.figures import pair_figure, path_figure, strata_figure, worst_frame
from mint_hub.evaluation.predictor import Predictor
from mint_hub.evaluation.results import ClipResult, Results
from mint_hub.evaluation.tables import (
    Table,
    all_tables,
    efficiency_line,
    published,
    write_markdown,
)
from mint_hub.evaluation.trivial import MeanHand, trivial_predictions
from mint_hub.geometry.metrics import measure_of, number
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.schema import Episode
from mint_hub.view import canvas
from mint_hub.view.canvas import Image
from mint_hub.view.page import page

RESULTS: Final = "results.json"
TABLES: Final = "tables.md"
REPORT: Final = "report.html"
FIGURES: Final = (
    ("wrist depth", "EPE-p", "px"),
    ("wrist depth", "CT-p", "m"),
    ("hidden share", "EPE-p", "px"),
    ("hidden share", "Recall", ""),
    ("wrist speed", "MPJPE-p", "mm"),
    ("field of view", "CT-p", "m"),
)
TILES: Final = (
    ("hands", "Presence-BA", "mean hand"),
    ("hands", "FAcc", "always present"),
    ("hands", "MPJPE-p", "always present"),
    ("hands", "EPE-p", "always present"),
    ("hands", "CT-p", "always present"),
    ("camera", "RPE-T mean", "zero camera motion"),
    ("camera", "RPE-R mean", "zero camera motion"),
    ("world", "W-MPJPE", "zero camera motion"),
)
STYLE: Final = """<style>
.tiles { display: grid; grid-template-columns: repeat(auto-fill, minmax(240px, 1fr)); gap: 14px;
  margin: 28px 0 0; }
.tile { padding: 16px 18px; border: 1px solid var(--rule); border-radius: 12px; }
.tile h3 { margin: 0; font-size: 13px; font-weight: 500; color: var(--muted); }
.tile b { display: block; margin: 2px 0 0; font-size: 27px; font-weight: 600;
  letter-spacing: -.02em; }
.tile b small { font-size: 14px; font-weight: 400; color: var(--muted); letter-spacing: 0; }
.tile p { margin: 6px 0 0; font-size: 12.5px; line-height: 1.4; color: var(--muted); }
.tile p.poor { color: var(--warn); }
.wide { overflow-x: auto; border: 1px solid var(--rule); border-radius: 12px; }
.wide table { font-size: 13px; }
.wide th, .wide td { padding: 8px 14px; text-align: right; white-space: nowrap; }
.wide thead th { vertical-align: bottom; white-space: normal; min-width: 74px; font-size: 12px;
  background: var(--soft); }
.wide th:first-child { position: sticky; left: 0; text-align: left; background: var(--paper); }
.wide thead th:first-child { background: var(--soft); }
.wide tr:last-child th, .wide tr:last-child td { border-bottom: 0; }
.wide td small { display: block; font-size: 10.5px; color: var(--muted); }
.ours th, .ours td { font-weight: 600; color: var(--ink); }
.ours td small { font-weight: 400; }
.note { margin: 0 0 10px; font-size: 13.5px; color: var(--muted); max-width: 84ch; }
.theirs { padding: 24px 26px; margin-top: 40px; background: var(--soft); border-radius: 14px; }
.theirs .wide { background: var(--paper); }
.plots { display: grid; grid-template-columns: repeat(auto-fill, minmax(440px, 1fr)); gap: 16px; }
.plots .plot { margin: 0; }
.worst { margin: 0 0 26px; }
.worst h3 { margin: 0 0 2px; font-size: 15px; overflow-wrap: anywhere; }
.worst .note { max-width: none; }
.worst .row { display: grid; grid-template-columns: minmax(0, 3.2fr) minmax(0, 1fr); gap: 12px;
  margin-top: 8px; }
.worst figure { margin: 0; }
.worst .path { display: flex; align-items: center; border-radius: 10px;
  background: rgb(243, 245, 247); }
@media (max-width: 700px) {
  .plots, .worst .row { grid-template-columns: 1fr; }
  .tiles { grid-template-columns: 1fr 1fr; }
}
</style>"""


def write_report(
    results: Results,
    folder: Path,
    source: Source | None = None,
    predictor: Predictor | None = None,
    mean: MeanHand | None = None,
    worst: int = 10,
) -> Path:
    """Write ``results.json``, ``tables.md``, pictures and ``report.html``; return the page's path.

    Args:
        results: what was found.
        folder: where to write.
        source: the benchmark, to draw worst clips from; none are drawn without it.
        predictor: what was scored; the "always present" row is drawn without it.
        mean: as in ``evaluate``.
        worst: how many of the worst clips to show.

    Raises:
        BenchmarkError: a worst clip cannot be read again.

    """
    results.save(folder / RESULTS)
    write_markdown(results, folder / TABLES)
    figures = list(_figures(results))
    shown = list(_worst(results, source, predictor, mean, worst)) if source else []
    drawn = [(f"worst-{w.clip.key}", w.pair) for w in shown]
    drawn += [(f"path-{w.clip.key}", w.path) for w in shown]
    for name, image in [*figures, *drawn]:
        with replacing(folder / "figures" / f"{name}.png") as temporary:
            temporary.write_bytes(canvas.png_bytes(image))
    title = f"{results.benchmark['title']}: {_who(results)}"
    body = [STYLE, _header(results), _tiles(results), _warnings(results), _plots(figures)]
    body += [_table(table) for table in all_tables(results)]
    body += [_efficiency(results), _published(results), _worst_section(results, shown)]
    with replacing(folder / REPORT) as temporary:
        temporary.write_text(page(title, "\n".join(filter(None, body))), encoding="utf-8")
    return folder / REPORT


def worst_clips(results: Results, count: int) -> list[ClipResult]:
    """The clips with the largest EPE-p of the first row that has hands; without hands, ATE."""

    def hands(clip: ClipResult) -> float:
        scores = (s.hands.get("published") for s in clip.scores.values())
        value = next((s.metrics()["EPE-p"] for s in scores if s is not None), float("nan"))
        return value

    def path(clip: ClipResult) -> float:
        cameras = (s.camera for s in clip.scores.values())
        return next((c.se3.ate_mm for c in cameras if c is not None), float("nan"))

    measured = [(hands(clip), clip) for clip in results.clips]
    if all(isnan(value) for value, _ in measured):
        measured = [(path(clip), clip) for clip in results.clips]
    ranked = sorted((m for m in measured if not isnan(m[0])), key=lambda m: -m[0])
    return [clip for _, clip in ranked[:count]]


# ------------------------------------------------------------------------- worst clips


@dataclass(frozen=True, eq=False)
class _Worst:
    result: ClipResult
    clip: Clip
    frame: int
    pair: Image
    path: Image


def _worst(
    results: Results,
    source: Source,
    predictor: Predictor | None,
    mean: MeanHand | None,
    count: int,
) -> Iterator[_Worst]:
    benchmark = open_benchmark(source)
    wanted = worst_clips(results, count)
    numbers = {results_clip.key: i for i, results_clip in enumerate(results.clips)}
    skipped = set(results.skipped)
    opened = predictor.open() if predictor else None
    by_number = list(range(len(benchmark)))
    if skipped:  # numbers in the results leave the skipped clips out
        by_number = [i for i in by_number if benchmark.clip(i).key not in skipped]
    for result in wanted:
        clip = benchmark.clip(by_number[numbers[result.key]])
        predicted: Episode
        if opened is not None:
            predicted = opened.predict(clip).episode
        else:
            predicted = trivial_predictions(clip.truth, mean or MeanHand.load())["always present"]
        frame = worst_frame(clip, predicted)
        picture = None
        if clip.frames is not None:
            picture = next(clip.frames.images(frame), None)
        model = None if opened is None else opened.hand_model
        pair = pair_figure(clip, predicted, frame, picture, model)
        yield _Worst(result, clip, frame, pair, path_figure(clip, predicted))


def _worst_section(results: Results, shown: Sequence[_Worst]) -> str:
    if not shown:
        return ""
    items: list[str] = []
    for item in shown:
        row = next(iter(item.result.scores.values()))
        numbers: list[str] = []
        if "published" in row.hands:
            metrics = row.hands["published"].metrics()
            for name in ("EPE-p", "MPJPE-p", "CT-p", "Recall"):
                unit = measure_of(name).unit
                numbers.append(f"{name} {number(metrics[name], unit)} {unit}".strip())
        if row.camera is not None:
            numbers.append(f"ATE {number(row.camera.se3.ate_mm, 'mm')} mm")
        time = float(item.clip.truth.timestamps_s[item.frame])
        pair = _img(canvas.jpeg_bytes(item.pair), "jpeg", f"Truth and prediction at {time:.2f} s")
        path = _img(canvas.png_bytes(item.path), "png", "Camera paths from above")
        items.append(
            f'<div class="worst"><h3>{html.escape(item.clip.key)}</h3>'
            f'<p class="note">{html.escape(" · ".join(numbers))} · frame {item.frame} at '
            f'{time:.2f} s, the worst of it</p><div class="row">'
            f'<figure>{pair}</figure><figure class="path">{path}</figure></div></div>'
        )
    who = html.escape(_who(results) if results.prediction else "always present")
    return (
        f'<section><h2>Worst clips</h2><p class="note">Left the truth, right {who}, both '
        "through the true camera; beside them the camera path from above, aligned by SE(3), "
        f"forward up, a ring at the start.</p>{''.join(items)}</section>"
    )


# ----------------------------------------------------------------------------- sections


def _who(results: Results) -> str:
    return str(results.prediction["name"]) if results.prediction else "trivial rows"


def _header(results: Results) -> str:
    facts = results.benchmark
    about = [
        f"{facts['clips']:,} clips",
        f"{facts['frames']:,} frames",
        f"hash {facts['hash']}",
        f"mint-hub {results.mint_hub}",
        results.date.replace("T", " ").replace("+00:00", " UTC"),
    ]
    kind = results.prediction["kind"] if results.prediction else "no prediction"
    return (
        f"<header><h1>{html.escape(_who(results))}</h1>"
        f'<p class="sub">{html.escape(kind)} on <b>{html.escape(str(facts["title"]))}</b> · '
        f"{html.escape(' · '.join(about))}</p></header>"
    )


def _tiles(results: Results) -> str:
    """The numbers to look at first, each beside the answer that needs no model."""
    row = results.rows[0]
    tiles: list[str] = []
    for group, column, beside in TILES:
        own, other = (_triple(results, r, group, column) for r in (row, beside))
        if own is None or isnan(own[0]) or row != "prediction":
            continue
        measure = measure_of(column)
        interval = (
            ""
            if isnan(own[1])
            else (f"{number(own[1], measure.unit)} to {number(own[2], measure.unit)}, 95 %<br>")
        )
        text, poor = "", ""
        if other is not None and not isnan(other[0]):
            text = f"{html.escape(beside)}: {number(other[0], measure.unit)}"
            if measure.ideal is not None:
                worse = abs(own[0] - measure.ideal) >= abs(other[0] - measure.ideal)
                poor = ' class="poor"' if worse else ""
                text += ", no worse than this" if worse else ""
        tiles.append(
            f'<div class="tile"><h3>{html.escape(column)}</h3><b>{number(own[0], measure.unit)} '
            f"<small>{html.escape(measure.unit)}</small></b><p{poor}>{interval}{text}</p></div>"
        )
    return f'<div class="tiles">{"".join(tiles)}</div>' if tiles else ""


def _triple(
    results: Results, row: str, group: str, column: str
) -> tuple[float, float, float] | None:
    found = results.summary.get(row, {}).get(group, {})
    found = found.get({"hands": "published", "world": "SE(3)"}.get(group, ""), found)
    return found.get(column)


def _warnings(results: Results) -> str:
    notes = [*results.benchmark["notes"], f"mean hand: of {results.trained_on}"]
    words = ". ".join(note[:1].upper() + note[1:] for note in notes)
    items = "".join(f"<li>{html.escape(text)}</li>" for text in results.warnings)
    warn = f'<section class="warn"><h2>Warnings</h2><ul>{items}</ul></section>' if items else ""
    return f'{warn}<section><p class="note">{html.escape(words)}.</p></section>'


def _figures(results: Results) -> Iterable[tuple[str, Image]]:
    for stratum, metric, unit in FIGURES:
        image = strata_figure(results, stratum, metric, unit)
        if image is not None:
            yield f"{metric}-by-{stratum.replace(' ', '-')}", image


def _plots(figures: Sequence[tuple[str, Image]]) -> str:
    if not figures:
        return ""
    items = "".join(
        f'<figure class="plot">{_img(canvas.png_bytes(image), "png", name)}</figure>'
        for name, image in figures
    )
    return f'<section><h2>Where it fails</h2><div class="plots">{items}</div></section>'


def _table(table: Table) -> str:
    heads = "".join(f"<th>{html.escape(c)}</th>" for c in ("", *table.columns))
    rows = "".join(
        f'<tr class="{kind}"><th scope="row">{html.escape(name)}</th>'
        + "".join(
            f"<td>{html.escape(c.text)}<small>{html.escape(c.interval)}</small></td>" for c in row
        )
        + "</tr>"
        for (name, row), kind in zip(table.rows, table.kinds, strict=True)
    )
    note = f'<p class="note">{html.escape(table.note)}</p>' if table.note else ""
    return (
        f'<section><h2>{html.escape(table.title)}</h2>{note}<div class="wide"><table><thead><tr>'
        f"{heads}</tr></thead><tbody>{rows}</tbody></table></div></section>"
    )


def _efficiency(results: Results) -> str:
    if not results.efficiency:
        return ""
    line = html.escape(efficiency_line(results.efficiency))
    return f"<section><h2>Efficiency</h2><p>{line}</p></section>"


def _published(results: Results) -> str:
    theirs = published(results)
    if not theirs:
        return ""
    tables = "".join(_table(table) for table, _ in theirs)
    return (
        '<div class="theirs"><h2>Published numbers, not run here</h2><p class="note">Copied from '
        f"their source, to read beside ours; nothing in this box was measured by us.</p>{tables}"
        "</div>"
    )


def _img(data: bytes, kind: str, words: str) -> str:
    text = base64.b64encode(data).decode("ascii")
    return f'<img alt="{html.escape(words)}" src="data:image/{kind};base64,{text}">'
