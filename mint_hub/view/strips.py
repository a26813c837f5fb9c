"""Time strips under a figure: presence, text and scores against seconds; and ticks for any axis."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from mint_hub.conventions import SIDES
from mint_hub.loaders.schema import Episode, TextSegment
from mint_hub.view import canvas
from mint_hub.view.canvas import FAINT, INK, MUTED, RULE, SIDE_COLORS, WHITE, Color, Image

LABEL_WIDTH: Final = 118
BAR: Final = 22
ROW: Final = 30
SCORE_HEIGHT: Final = 150
MAX_TEXT_ROWS: Final = 4


@dataclass(frozen=True)
class Box:
    """A rectangle of the page, in pixels before magnification."""

    left: float
    top: float
    right: float
    bottom: float


@dataclass(frozen=True)
class TimeAxis:
    """Seconds to pixels of the magnified page."""

    left: float
    right: float
    begin_s: float
    end_s: float

    def x(self, time_s: float) -> float:
        """Where this time is."""
        share = (time_s - self.begin_s) / (self.end_s - self.begin_s)
        return self.left + share * (self.right - self.left)


def strips_height(episode: Episode) -> int:
    """Return the pixels that ``draw_strips`` needs, before magnification."""
    rows = len(SIDES) + len(text_rows(episode.text))
    return 24 + rows * ROW + 62 + SCORE_HEIGHT + 80


def draw_strips(image: Image, episode: Episode, box: Box, scale: int) -> None:
    """Draw presence bars, text segments and scores into ``box`` of a magnified page."""
    s = scale
    begin = float(episode.timestamps_s[0])
    axis = TimeAxis((box.left + LABEL_WIDTH) * s, box.right * s, begin, begin + episode.duration_s)
    starts = episode.timestamps_s.tolist()
    ends = [*starts[1:], axis.end_s]
    left = box.left * s
    canvas.put_text(image, "Hands and actions over time", (left, box.top * s), 20 * s, weight=600)
    y = (box.top + 20) * s
    for hand, side in enumerate(SIDES):
        share = f"{side}  {100 * episode.presence[:, hand].mean():.0f} %"
        canvas.put_text(image, share, (left, y + 16 * s), 16 * s, MUTED)
        canvas.rectangle(image, (axis.left, y), (axis.right, y + BAR * s), FAINT, 4 * s)
        for run in canvas.runs(episode.presence[:, hand]):
            a, b = axis.x(starts[run.start]), axis.x(ends[run.stop - 1])
            canvas.rectangle(image, (a, y), (b, y + BAR * s), SIDE_COLORS[hand], 4 * s)
        y += ROW * s
    for i, row in enumerate(text_rows(episode.text)):
        if i == 0:
            canvas.put_text(image, "text", (left, y + 16 * s), 16 * s, MUTED)
        for segment in row:
            span = axis.x(starts[segment.start]), axis.x(ends[segment.end - 1])
            _segment(image, segment, span, y, s)
        y += ROW * s
    _scores(image, episode, axis, (left, y + 46 * s, y + (46 + SCORE_HEIGHT) * s), s)


def text_rows(text: tuple[TextSegment, ...]) -> list[list[TextSegment]]:
    """Put segments into rows without overlap, first come first placed; at most MAX_TEXT_ROWS."""
    rows: list[list[TextSegment]] = []
    for segment in sorted(text, key=lambda s: (s.start, s.end)):
        free = next((row for row in rows if row[-1].end <= segment.start), None)
        if free is not None:
            free.append(segment)
        elif len(rows) < MAX_TEXT_ROWS:
            rows.append([segment])
    return rows


def _segment(
    image: Image, segment: TextSegment, span: tuple[float, float], y: float, s: int
) -> None:
    color: Color = MUTED
    if segment.side in SIDES:
        color = SIDE_COLORS[SIDES.index(segment.side)]
    a, b = span[0] + 0.5 * s, span[1] - 0.5 * s
    canvas.rectangle(image, (a, y), (b, y + BAR * s), canvas.mix(WHITE, color, 0.16), 4 * s)
    canvas.rectangle(image, (a, y), (a + 4 * s, y + BAR * s), color)
    label = canvas.fit_text(segment.text, 15 * s, b - a - 18 * s)
    canvas.put_text(image, label, (a + 12 * s, y + 16 * s), 15 * s, INK)


def _scores(
    image: Image, episode: Episode, axis: TimeAxis, place: tuple[float, float, float], s: int
) -> None:
    left, top, bottom = place
    canvas.put_text(image, "score", (left, top + 6 * s), 16 * s, MUTED)
    for value in (0.0, 0.5, 1.0):
        y = bottom + value * (top - bottom)
        canvas.line(image, (axis.left, y), (axis.right, y), RULE, s)
        spot = (axis.left - 12 * s, y + 5 * s)
        canvas.put_text(image, f"{value:.1f}", spot, 15 * s, MUTED, anchor="right")
    step = nice_step(axis.end_s - axis.begin_s, 15)
    for tick in ticks(axis.begin_s, axis.end_s, step):
        x = axis.x(tick)
        canvas.line(image, (x, bottom), (x, bottom + 6 * s), MUTED, s)
        spot = (x, bottom + 25 * s)
        canvas.put_text(image, tick_label(tick, step), spot, 15 * s, MUTED, anchor="center")
    spot = (axis.right, bottom + 50 * s)
    canvas.put_text(image, "time (s)", spot, 16 * s, INK, anchor="right")
    if episode.presence_score is None:
        spot = ((axis.left + axis.right) / 2, (top + bottom) / 2 - 12 * s)
        canvas.put_text(image, "no scores recorded", spot, 17 * s, MUTED, anchor="center")
        return
    starts = episode.timestamps_s.tolist()
    edges = list(zip(starts, [*starts[1:], axis.end_s], strict=True))
    x = np.array([[axis.x(a), axis.x(b)] for a, b in edges]).ravel()
    for hand in reversed(range(len(SIDES))):
        score = np.repeat(episode.presence_score[:, hand].astype(float), 2)
        y = bottom + score * (top - bottom)
        canvas.polyline(image, np.stack([x, y], axis=-1), SIDE_COLORS[hand], 2 * s)


# ------------------------------------------------------------------- ticks


def nice_step(span: float, count: int) -> float:
    """Return the distance among 1, 2, 5 times a power of ten that gives about ``count`` ticks.

    >>> nice_step(1.0, 5), nice_step(7.3, 5), nice_step(0.24, 5)
    (0.2, 2.0, 0.05)
    """
    raw = span / count
    power = math.floor(math.log10(raw))
    factor = next(f for f in (1, 2, 5, 10) if f * 10.0**power >= raw * (1 - 1e-9))
    return float(f"{factor}e{power}")


def ticks(low: float, high: float, step: float) -> list[float]:
    """Return the multiples of ``step`` in low .. high.

    >>> ticks(-0.25, 0.4, 0.2)
    [-0.2, 0.0, 0.2, 0.4]
    """
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [k * step for k in range(first, last + 1)]


def tick_label(value: float, step: float) -> str:
    """Write a tick with the digits that its step needs, and never "-0".

    >>> tick_label(-0.0, 0.5), tick_label(0.30000000000000004, 0.1), tick_label(20.0, 10.0)
    ('0.0', '0.3', '20')
    """
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    return f"{round(value, digits) + 0.0:.{digits}f}"
