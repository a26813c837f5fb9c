"""Scores of training runs over the frames seen: a panel for each, as one picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import cv2
import numpy as np

from mint_hub.geometry.metrics import measure_of
from mint_hub.view import canvas
from mint_hub.view.canvas import INK, MUTED, RULE, SIDE_COLORS, Image
from mint_hub.view.strips import nice_step, tick_label, ticks

__all__ = ["training_curve"]

SHOWN: Final = (
    "MPJPE-p",
    "PA-MPJPE-p",
    "GO-p",
    "CT-p",
    "EPE-p",
    "Presence-BA",
    "RPE-T",
    "RPE-R",
    "fov-error",
)
_COLUMNS: Final = 3
_SCALE: Final = 2
_PANEL_HW: Final = (190, 300)


def training_curve(log: Sequence[Mapping[str, Any]]) -> Image:
    """Draw the scores in the lines of a log, (H, W, 3) uint8 RGB.

    Args:
        log: lines of ``log.jsonl``; those with scores hold ``frames`` and ``eval_NAME``, and
            ``run`` where several runs follow each other: a rule marks where one begins.

    Raises:
        ValueError: no line has scores.

    """
    scored = [line for line in log if any(f"eval_{name}" in line for name in SHOWN)]
    if not scored:
        raise ValueError("log: expected lines with scores (eval_...), found none")
    height, width = (_SCALE * n for n in _PANEL_HW)
    names = [name for name in SHOWN if any(f"eval_{name}" in line for line in scored)]
    rows = -(-len(names) // _COLUMNS)
    image = canvas.blank(rows * height, _COLUMNS * width)
    for k, name in enumerate(names):
        top, left = k // _COLUMNS * height, k % _COLUMNS * width
        _panel(image[top : top + height, left : left + width], name, scored)
    small = (image.shape[1] // _SCALE, image.shape[0] // _SCALE)
    return cv2.resize(image, small, interpolation=cv2.INTER_AREA).astype(np.uint8)


def _panel(image: Image, name: str, scored: Sequence[Mapping[str, Any]]) -> None:
    s = _SCALE
    height, width = image.shape[:2]
    lines = [line for line in scored if f"eval_{name}" in line]
    seen = np.array([line["frames"] for line in lines], float)
    values = np.array([line[f"eval_{name}"] for line in lines], float)
    unit = "deg" if name == "fov-error" else measure_of(name).unit
    title = "fov error" if name == "fov-error" else name
    canvas.put_text(
        image, f"{title} ({unit})" if unit else title, (12 * s, 22 * s), 13 * s, INK, weight=600
    )
    left, right, top, bottom = 50 * s, width - 14 * s, 36 * s, height - 30 * s
    last, highest = max(seen.max(), 1.0), max(1.05 * values.max(), 1e-9)

    def place(frames: Any, value: Any) -> Any:
        x = left + np.asarray(frames) / last * (right - left)
        return np.stack([x, bottom - np.asarray(value) / highest * (bottom - top)], -1)

    step = nice_step(highest, 3)
    for tick in ticks(0.0, highest, step):
        at = place(0, tick)
        canvas.line(image, at, (right, at[1]), RULE, s)
        spot = (left - 6 * s, at[1] + 4 * s)
        canvas.put_text(image, tick_label(tick, step), spot, 10 * s, MUTED, anchor="right")
    runs = np.array([line.get("run", 0) for line in lines])
    for k in np.flatnonzero(np.diff(runs)) + 1:
        x = place((seen[k - 1] + seen[k]) / 2, 0)[0]
        canvas.line(image, (x, top), (x, bottom), MUTED, s)
    canvas.polyline(image, place(seen, values), SIDE_COLORS[0], 1.6 * s)
    for frames, value in zip(seen, values, strict=True):
        canvas.disc(image, place(frames, value), 2.2 * s, SIDE_COLORS[0])
    text = f"{last:,.0f} frames"
    canvas.put_text(image, text, (right, bottom + 18 * s), 10 * s, MUTED, anchor="right")
    canvas.put_text(image, "0", (left, bottom + 18 * s), 10 * s, MUTED, anchor="center")
