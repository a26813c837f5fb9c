"""Pictures of a report, drawn with OpenCV: errors by stratum, paths from above, worst clips."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from mint_hub.evaluation.clips import Clip
from mint_hub.evaluation.results import Results
from mint_hub.evaluation.scoring import ClipScorer, model_for
from mint_hub.geometry import rigid
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.hand_state import unpack
from mint_hub.geometry.metrics import align_paths
from mint_hub.loaders.schema import Episode
from mint_hub.view import canvas
from mint_hub.view.canvas import CAMERA, FAINT, INK, MUTED, RULE, SIDE_COLORS, WHITE, Color, Image
from mint_hub.view.overlay import draw_overlay
from mint_hub.view.strips import nice_step, tick_label, ticks

SCALE: Final = 2
SERIES: Final[tuple[tuple[str, Color], ...]] = (
    ("prediction", SIDE_COLORS[0]),
    ("mean hand", (150, 158, 168)),
    ("last frame copied", (222, 178, 120)),
)
TRUE_PATH: Final = CAMERA
PREDICTED_PATH: Final = SIDE_COLORS[1]
DARK: Final = (34, 38, 44)
MISS_M: Final = 0.1


@dataclass(frozen=True)
class Bar:
    """One value of a series within a group; NaN is drawn as nothing."""

    series: str
    value: float


def strata_figure(results: Results, stratum: str, metric: str, unit: str) -> Image | None:
    """Draw ``metric`` by the bins of one stratum, a bar a row of SERIES; None without bins."""
    shown = [(name, color) for name, color in SERIES if name in results.rows]
    bins: dict[str, list[Bar]] = {}
    for name, _ in shown:
        for key, found in results.summary[name]["strata"].items():
            kind, _, label = key.partition(": ")
            if kind == stratum and found["hands"]:
                bins.setdefault(label, []).append(Bar(name, float(found[metric])))
    if not bins:
        return None
    groups = sorted(bins.items(), key=lambda item: float(item[0].split()[0]))
    legend = [(results.title(name), color) for name, color in shown]
    return bar_chart(f"{metric} by {stratum}", unit, groups, legend, dict(SERIES))


def bar_chart(
    title: str,
    unit: str,
    groups: Sequence[tuple[str, Sequence[Bar]]],
    legend: Sequence[tuple[str, Color]],
    colors: dict[str, Color],
    size_hw: tuple[int, int] = (380, 780),
) -> Image:
    """Draw groups of bars from zero, (H, W, 3)."""
    s, (height, width) = SCALE, size_hw
    image = canvas.blank(height * s, width * s)
    title = f"{title} ({unit})" if unit else title
    canvas.put_text(image, title, (28 * s, 40 * s), 20 * s, INK, weight=600)
    x = 28.0 * s
    for name, color in legend:
        canvas.rectangle(image, (x, 58 * s), (x + 14 * s, 72 * s), color, 3 * s)
        name = canvas.fit_text(name, 15 * s, 300 * s)
        canvas.put_text(image, name, (x + 21 * s, 71 * s), 15 * s, MUTED)
        x += (44 * s) + canvas.text_width(name, 15 * s)
    left, right, top, bottom = 74 * s, (width - 24) * s, 96 * s, (height - 62) * s
    values = [bar.value for _, bars in groups for bar in bars if np.isfinite(bar.value)]
    highest = 1.08 * max([*values, 1e-9])
    step = nice_step(highest, 5)
    for tick in ticks(0.0, highest, step):
        y = bottom - tick / highest * (bottom - top)
        canvas.line(image, (left, y), (right, y), RULE, s)
        spot = (left - 10 * s, y + 5 * s)
        canvas.put_text(image, tick_label(tick, step), spot, 14 * s, MUTED, anchor="right")
    slot = (right - left) / len(groups)
    for i, (label, bars) in enumerate(groups):
        wide = min(46 * s, 0.78 * slot / max(1, len(bars)))
        start = left + (i + 0.5) * slot - wide * len(bars) / 2
        for k, bar in enumerate(bars):
            if np.isfinite(bar.value):
                y = bottom - bar.value / highest * (bottom - top)
                a = (start + k * wide + 2 * s, y)
                canvas.rectangle(
                    image, a, (start + (k + 1) * wide - 2 * s, bottom), colors[bar.series]
                )
        at = (left + (i + 0.5) * slot, bottom + 26 * s)
        text = canvas.fit_text(label, 15 * s, slot)
        canvas.put_text(image, text, at, 15 * s, INK, anchor="center")
    canvas.line(image, (left, bottom), (right, bottom), MUTED, 1.5 * s)
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)


def path_figure(clip: Clip, predicted: Episode, size: int = 360) -> Image:
    """Draw the true and the predicted camera path from above, aligned by SE(3).

    Seen along the first true camera's y axis: right is right, forward is up.
    """
    s = SCALE
    image = canvas.blank(size * s, size * s, FAINT)
    G, P = clip.truth.T_world_from_camera, predicted.T_world_from_camera
    fit = align_paths(P, G, with_scale=False)
    into = rigid.inverse(G[0])
    paths = [
        rigid.transform_points(into, points)[:, [0, 2]]
        for points in (G[:, :3, 3], fit.apply(P[:, :3, 3]))
    ]
    both = np.concatenate(paths)
    low, high = both.min(axis=0), both.max(axis=0)
    span = max(0.02, 1.25 * float((high - low).max()))
    for path, color, wide in zip(paths, (TRUE_PATH, PREDICTED_PATH), (3.0, 2.2), strict=True):
        unit = (path - (low + high) / 2) / span * (1, -1) + 0.5
        pixels = unit * size * s
        canvas.polyline(image, pixels, color, wide * s)
        canvas.disc(image, pixels[-1], 5.5 * s, color)
        canvas.disc(image, pixels[0], 5 * s, color, 2 * s)
    step = nice_step(span, 4)
    bar = step / span * size * s
    at = ((size - 16) * s, (size - 18) * s)
    canvas.line(image, (at[0] - bar, at[1]), at, MUTED, 2 * s)
    label = f"{tick_label(step, step)} m" if step >= 0.1 else f"{1e3 * step:g} mm"
    spot = (at[0] - bar / 2, at[1] - 9 * s)
    canvas.put_text(image, label, spot, 14 * s, MUTED, anchor="center")
    for k, (name, color) in enumerate((("true", TRUE_PATH), ("predicted", PREDICTED_PATH))):
        y = (24 + 22 * k) * s
        canvas.line(image, (14 * s, y), (34 * s, y), color, 3 * s)
        canvas.put_text(image, name, (42 * s, y + 5 * s), 14 * s, INK)
    return cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA).astype(np.uint8)


def worst_frame(clip: Clip, predicted: Episode) -> int:
    """Number of the frame whose hands are furthest off; one missed or made up counts MISS_M.

    As scored: a true hand off screen is neither missed nor, where predicted, made up.
    """
    truth, guess = clip.truth, predicted.presence
    seen = ClipScorer(clip).seen()
    place, other = (unpack(e.hand_state.astype(float)).translation for e in (truth, predicted))
    far = np.linalg.norm(place - other, axis=-1)
    wrong = (seen & ~guess) | (~truth.presence & guess)
    error = np.where(seen & guess, far, np.where(wrong, MISS_M, 0.0))
    return int(error.sum(axis=1).argmax())


def pair_figure(
    clip: Clip,
    predicted: Episode,
    frame: int,
    picture: Image | None,
    hand_model: HandModel | None = None,
    height: int = 330,
) -> Image:
    """Draw the truth (left) and the prediction (right) over a frame; on grey without a picture.

    Both through the true camera and with the hands that they are scored with.
    """
    rows, columns = clip.image_size_hw
    blank = canvas.blank(rows, columns, DARK)
    shown = blank if picture is None else np.ascontiguousarray(picture)
    truth = replace(clip.truth, presence_score=None)
    guess = replace(
        predicted,
        fov_vh_rad=clip.truth.fov_vh_rad,
        image_size_hw=clip.truth.image_size_hw,
        presence_score=None,
    )
    sides = [
        draw_overlay(shown, truth, frame, clip.hand_model),
        draw_overlay(shown, guess, frame, model_for(predicted, clip, hand_model)),
    ]
    width = round(columns * height / rows)
    small = [cv2.resize(i, (width, height), interpolation=cv2.INTER_AREA) for i in sides]
    gap: NDArray[np.uint8] = np.full((height, 6, 3), WHITE, np.uint8)
    return np.concatenate([small[0], gap, small[1]], axis=1).astype(np.uint8)
