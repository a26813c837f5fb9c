"""The frame of our HTML pages: one neutral style for light and dark, and small drawings as SVG."""

import html
from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import SIDES
from mint_hub.loaders.schema import Episode
from mint_hub.view import canvas
from mint_hub.view.canvas import SIDE_COLORS

THUMBNAIL: Final = 120
MAX_POINTS: Final = 300

STYLE: Final = """
:root { color-scheme: light dark; --paper: #fff; --ink: #1f242b; --muted: #6b7480; --rule: #e5e8ec;
  --soft: #f5f6f8; --link: #006ebe; --warn: #9a4b00; --warn-soft: #fff5ea; --camera: #3e4652; }
@media (prefers-color-scheme: dark) { :root { --paper: #14171b; --ink: #e6e9ed; --muted: #98a1ac;
  --rule: #2a2f36; --soft: #1c2025; --link: #6db7f2; --warn: #ffb469; --warn-soft: #2b2117;
  --camera: #c4ccd6; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1160px; padding: 48px 32px 72px; background: var(--paper);
  color: var(--ink); font: 15px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif;
  font-variant-numeric: tabular-nums; }
h1 { margin: 0; font-size: 30px; line-height: 1.2; letter-spacing: -.015em;
  overflow-wrap: anywhere; }
h2 { margin: 0 0 10px; font-size: 17px; }
section, .plot { margin: 32px 0 0; }
.sub { margin: 6px 0 0; color: var(--muted); }
a { color: var(--link); text-decoration: none; }
a:hover { text-decoration: underline; }
nav { display: flex; flex-wrap: wrap; gap: 8px; margin-top: 14px; }
nav a { padding: 3px 12px; border: 1px solid var(--rule); border-radius: 99px; font-size: 13px; }
figure { margin: 0; }
img { display: block; width: 100%; height: auto; border-radius: 8px; }
.stills { display: grid; grid-template-columns: repeat(auto-fill, minmax(300px, 1fr)); gap: 12px; }
.plot { border: 1px solid var(--rule); border-radius: 12px; overflow: hidden; background: #fff; }
.plot img { border-radius: 0; }
table { width: 100%; border-collapse: collapse; }
th, td { padding: 7px 16px 7px 0; border-bottom: 1px solid var(--rule); text-align: left;
  vertical-align: top; }
th { font-weight: 500; color: var(--muted); white-space: nowrap; }
.facts th { width: 170px; }
.text td:last-child { width: 60%; }
.warn { padding: 16px 20px; border-left: 4px solid var(--warn); border-radius: 8px;
  background: var(--warn-soft); }
.warn h2 { color: var(--warn); margin-bottom: 4px; }
.warn ul { margin: 0; padding-left: 18px; }
summary { font-size: 17px; font-weight: 700; cursor: pointer; }
pre { margin: 10px 0 0; padding: 16px 20px; border-radius: 8px; background: var(--soft);
  font: 13px/1.5 ui-monospace, "SF Mono", Menlo, Consolas, monospace; overflow-x: auto; }
.cards { display: grid; grid-template-columns: repeat(auto-fill, minmax(440px, 1fr)); gap: 16px;
  margin: 28px 0 0; padding: 0; list-style: none; }
.card { display: flex; gap: 18px; padding: 16px; border: 1px solid var(--rule);
  border-radius: 12px; }
.card > div { flex: 1; min-width: 0; }
.card h2 { margin: 0; overflow-wrap: anywhere; }
.card nav { margin-top: 10px; }
.card svg.path { flex: none; border-radius: 8px; background: var(--soft); }
.card svg.strip { display: block; width: 100%; height: 17px; margin-top: 10px; }
.card.broken { display: block; border-color: var(--warn); }
.flag { margin-left: 6px; color: var(--warn); white-space: nowrap; }
footer { margin-top: 48px; color: var(--muted); font-size: 13px; }
@media (max-width: 520px) { body { padding: 24px 16px; } .cards { grid-template-columns: 1fr; } }
"""


def page(title: str, body: str) -> str:
    """Return a whole HTML document; ``body`` is markup, ``title`` is text."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{STYLE}</style></head>\n"
        f"<body>\n{body}\n<footer>Made with mint-hub. Camera axes: x right, y down, z forward; "
        "metres; the world is the camera of the first frame unless provenance says otherwise."
        "</footer>\n</body></html>\n"
    )


def facts_table(facts: Iterable[tuple[str, str]]) -> str:
    """Return a two-column table of names and values, both as text."""
    rows = "".join(
        f'<tr><th scope="row">{html.escape(name)}</th><td>{html.escape(value)}</td></tr>'
        for name, value in facts
    )
    return f'<section><h2>Facts</h2><table class="facts">{rows}</table></section>'


def presence_svg(episode: Episode) -> str:
    """Draw one bar a hand, filled where it is there."""
    count = episode.num_frames
    bars: list[str] = []
    for hand in range(len(SIDES)):
        y = 9 * hand
        bars.append(f'<rect width="{count}" y="{y}" height="7" fill="var(--soft)"/>')
        for run in canvas.runs(episode.presence[:, hand]):
            size = f'x="{run.start}" width="{run.stop - run.start}" y="{y}" height="7"'
            bars.append(f'<rect {size} fill="{_hex(SIDE_COLORS[hand])}"/>')
    words = ", ".join(
        f"{side} hand {100 * episode.presence[:, i].mean():.0f} %" for i, side in enumerate(SIDES)
    )
    return (
        f'<svg class="strip" viewBox="0 0 {count} 17" preserveAspectRatio="none" role="img">'
        f"<title>{words}</title>{''.join(bars)}</svg>"
    )


def trajectory_svg(episode: Episode) -> str:
    """Draw the camera and both wrists from above (x right, z up), fitted into a square."""
    step = max(1, -(-episode.num_frames // MAX_POINTS))
    wrists = episode.wrist_world()[::step, :, :3, 3]
    camera = episode.T_world_from_camera[::step, :3, 3]
    paths: list[tuple[NDArray[Any], str]] = [
        *((wrists[:, i][:, [0, 2]], _hex(SIDE_COLORS[i])) for i in range(len(SIDES))),
        (camera[:, [0, 2]], "var(--camera)"),
    ]
    points = np.concatenate([p for p, _ in paths])
    points = points[np.isfinite(points).all(axis=-1)]
    low, high = points.min(axis=0), points.max(axis=0)
    scale = (THUMBNAIL - 24) / max(0.1, float((high - low).max()))
    lines: list[str] = []
    for path, color in paths:
        pixels = (path - (low + high) / 2) * scale * (1, -1) + THUMBNAIL / 2
        for run in canvas.runs(np.isfinite(pixels).all(axis=-1)):
            corners = pixels[run].tolist()
            corners += corners[:1] * (len(corners) == 1)  # one point twice is a dot
            dots = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
            lines.append(f'<polyline points="{dots}" stroke="{color}"/>')
    size = f'width="{THUMBNAIL}" height="{THUMBNAIL}" viewBox="0 0 {THUMBNAIL} {THUMBNAIL}"'
    style = 'fill="none" stroke-width="2" stroke-linecap="round" stroke-linejoin="round"'
    return (
        f'<svg class="path" {size} {style} role="img"><title>Paths seen from above</title>'
        f"{''.join(lines)}</svg>"
    )


def _hex(color: tuple[int, int, int]) -> str:
    return "#" + "".join(f"{c:02x}" for c in color)
