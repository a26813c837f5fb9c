"""One page a clip, and an index of a folder of clips: single HTML files that open offline.

A result lies in one folder under one stem: ``stem.npz`` (the episode), ``stem.mp4`` (overlay),
``stem.png`` (plot), ``stem.rrd`` (3-D scene), ``stem.html`` (this page); each but the first may be
missing.
"""

import base64
import html
import json
from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import cv2
import numpy as np

from mint_hub.conventions import SIDES
from mint_hub.geometry.hand_model import HandModel
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.schema import Episode, EpisodeError
from mint_hub.loaders.video import VideoSource, iter_frames
from mint_hub.view import canvas
from mint_hub.view.canvas import Image, plural
from mint_hub.view.overlay import overlay_frames
from mint_hub.view.page import facts_table, page, presence_svg, trajectory_svg
from mint_hub.view.plots import trajectory_plot

STILL_WIDTH: Final = 480
LINKS: Final = (
    (".npz", "episode"),
    (".mp4", "overlay video"),
    (".png", "plot"),
    (".rrd", "3-D scene"),
)


def write_summary(
    episode: Episode,
    path: str | PathLike[str],
    video: VideoSource | None = None,
    overlay: str | PathLike[str] | None = None,
    num_stills: int = 6,
    hand_model: HandModel | None = None,
) -> Path:
    """Write the page of one clip and return its path.

    Files of the same stem beside the page are linked.

    Args:
        episode: what to show.
        path: where to write; must end in .html.
        video: the source video: stills are drawn from it.
        overlay: the overlay video that ``write_overlay`` made of the whole episode: stills are
            taken from it, which is faster. Without both there are no stills.
        num_stills: how many frames to show, evenly spread.
        hand_model: as in ``Episode.joints_camera``.

    Raises:
        VideoError: a given video cannot be read.
        ValueError: the path does not end in .html.

    """
    path = _html_path(path)
    count = min(num_stills, episode.num_frames)
    middles = (np.arange(count) + 0.5) * episode.num_frames / max(1, count)
    indices = [int(k) for k in middles]
    stills: Sequence[tuple[int, Image]] = ()
    if overlay is not None:
        stills = list(_stills_of_overlay(episode, overlay, indices))
    elif video is not None:
        stills = list(overlay_frames(episode, video, hand_model, only=set(indices)))
    body = [
        _header(episode, path),
        _warnings(episode.meta.get("warnings", ())),
        _stills(episode, stills),
        f'<figure class="plot"><img alt="Trajectories and presence over time" '
        f'src="{_data_uri(canvas.png_bytes(trajectory_plot(episode)), "png")}"></figure>',
        facts_table(_facts(episode)),
        _text(episode),
        _provenance(episode),
    ]
    return _write(path, page(episode.key, "\n".join(filter(None, body))))


def write_index(folder: str | PathLike[str]) -> Path:
    """Write ``index.html`` over every ``.npz`` episode under ``folder`` and return its path.

    A file that is no episode is listed with what is wrong with it.

    Raises:
        ValueError: ``folder`` is not a folder.

    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder of results")
    rows: list[str] = []
    frames, seconds, broken = 0, 0.0, 0
    for file in sorted(folder.rglob("*.npz")):
        if any(part.startswith(".") for part in file.relative_to(folder).parts):
            continue
        try:
            episode = Episode.load(file)
        except (EpisodeError, OSError) as error:
            broken += 1
            name = html.escape(file.relative_to(folder).as_posix())
            what = html.escape(str(error).removeprefix(f"{file}: "))
            rows.append(f'<li class="card broken"><h2>{name}</h2><p>{what}</p></li>')
            continue
        frames, seconds = frames + episode.num_frames, seconds + episode.duration_s
        rows.append(_card(episode, file, folder))
    count = len(rows) - broken
    total = f"{plural(count, 'clip')} · {plural(frames, 'frame')} · {_clock(seconds)}"
    if broken:
        total += f" · {broken} unreadable"
    listing = f'<ul class="cards">{"".join(rows)}</ul>' if rows else "<p>No episodes here yet.</p>"
    title = f"Results in {folder.resolve().name}"
    header = f'<header><h1>{html.escape(title)}</h1><p class="sub">{total}</p></header>'
    return _write(folder / "index.html", page(title, header + listing))


# ---------------------------------------------------------------- sections


def _header(episode: Episode, path: Path) -> str:
    links = "".join(
        f'<a href="{html.escape(_url(path.with_suffix(suffix).name))}">{label}</a>'
        for suffix, label in LINKS
        if path.with_suffix(suffix).is_file()
    )
    about = " · ".join(
        str(episode.meta[name]) for name in ("source", "uid") if episode.meta.get(name)
    )
    return (
        f"<header><h1>{html.escape(episode.key)}</h1>"
        f'<p class="sub">{html.escape(about)}</p><nav>{links}</nav></header>'
    )


def _warnings(warnings: Iterable[Any]) -> str:
    items = "".join(f"<li>{_plain(warning)}</li>" for warning in warnings)
    return f'<section class="warn"><h2>Warnings</h2><ul>{items}</ul></section>' if items else ""


def _stills(episode: Episode, stills: Sequence[tuple[int, Image]]) -> str:
    figures: list[str] = []
    for k, image in stills:
        height = round(image.shape[0] * STILL_WIDTH / image.shape[1])
        small = cv2.resize(image, (STILL_WIDTH, height), interpolation=cv2.INTER_AREA)
        data = _data_uri(canvas.jpeg_bytes(small.astype(np.uint8)), "jpeg")
        time = f"{episode.timestamps_s[k]:.2f} s"
        figures.append(f'<figure><img alt="Overlay at {time}" src="{data}"></figure>')
    return f'<section class="stills">{"".join(figures)}</section>' if figures else ""


def _facts(episode: Episode) -> list[tuple[str, str]]:
    height, width = episode.image_size_hw
    fov = np.degrees(episode.fov_vh_rad.astype(float))
    speed = episode.camera_speed_m_s()
    facts = [
        ("duration", f"{episode.duration_s:.2f} s, {plural(episode.num_frames, 'frame')}"),
        ("rate", f"{episode.fps:.4g} fps"),
        ("image", f"{width} x {height} pixels (width x height)"),
        ("field of view", f"{_span(fov[:, 0])} vertical, {_span(fov[:, 1])} horizontal"),
        ("camera path", f"{episode.path_length_m:.2f} m"),
        ("camera speed", f"{speed.mean():.2f} m/s mean, {speed.max():.2f} m/s largest"),
        ("scale", str(episode.meta.get("scale_status", "not stated"))),
    ]
    for hand, side in enumerate(SIDES):
        there = episode.presence[:, hand]
        line = f"{plural(int(there.sum()), 'frame')}, {100 * there.mean():.1f} %"
        if there.any():
            depth = episode.wrist_camera()[there, hand, 2, 3]
            line += f", wrist {depth.min():.2f} to {depth.max():.2f} m ahead"
        facts.append((f"{side} hand", line))
    model = episode.meta.get("hand_model", "not stated")
    facts.append(("hand model", f"{model}, shapes {episode.meta.get('shape_space', 'not stated')}"))
    return facts


def _span(degrees: Any) -> str:
    low, high = f"{degrees.min():.1f}", f"{degrees.max():.1f}"
    return f"{low}°" if low == high else f"{low}° to {high}°"


def _text(episode: Episode) -> str:
    if not episode.text:
        return ""
    rows = "".join(
        f"<tr><td>{episode.timestamps_s[s.start]:.2f} s</td>"
        f"<td>{plural(s.end - s.start, 'frame')}</td>"
        f"<td>{s.side or ''}</td><td>{html.escape(s.text)}</td></tr>"
        for s in episode.text
    )
    head = "<tr><th>from</th><th>for</th><th>hand</th><th>text</th></tr>"
    return f'<section><h2>Text</h2><table class="text">{head}{rows}</table></section>'


def _provenance(episode: Episode) -> str:
    shown = {
        name: f"({len(value)} values)" if isinstance(value, list) and len(value) > 40 else value
        for name, value in episode.meta.items()
        if name != "warnings"
    }
    text = html.escape(json.dumps(shown, indent=2, ensure_ascii=False))
    return (
        f"<section><details open><summary>Provenance</summary><pre>{text}</pre></details></section>"
    )


def _card(episode: Episode, file: Path, folder: Path) -> str:
    page_file = file.with_suffix(".html")
    name = html.escape(episode.key)
    if page_file.is_file():
        name = f'<a href="{_href(page_file, folder)}">{name}</a>'
    links = "".join(
        f'<a href="{_href(file.with_suffix(suffix), folder)}">{suffix[1:]}</a>'
        for suffix, _ in LINKS
        if file.with_suffix(suffix).is_file()
    )
    count = len(episode.meta.get("warnings", ()))
    flag = f'<span class="flag">{plural(count, "warning")}</span>' if count else ""
    return (
        f'<li class="card">{trajectory_svg(episode)}<div><h2>{name}</h2>'
        f'<p class="sub">{_clock(episode.duration_s)} · {episode.num_frames} frames · '
        f"path {episode.path_length_m:.2f} m {flag}</p>{presence_svg(episode)}"
        f"<nav>{links}</nav></div></li>"
    )


# ----------------------------------------------------------------- helpers


def _stills_of_overlay(
    episode: Episode, overlay: str | PathLike[str], indices: Iterable[int]
) -> Iterable[tuple[int, Image]]:
    for k in indices:
        time = float(episode.timestamps_s[k] - episode.timestamps_s[0])
        with iter_frames(overlay, fps=episode.fps, start_s=time) as frames:
            yield k, next(iter(frames)).image


def _html_path(path: str | PathLike[str]) -> Path:
    path = Path(path)
    if path.suffix.lower() != ".html":
        raise ValueError(f"{path}: expected a name that ends in .html")
    return path


def _write(path: Path, text: str) -> Path:
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def _data_uri(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


def _href(file: Path, folder: Path) -> str:
    return html.escape(_url(file.relative_to(folder).as_posix()))


def _url(path: str) -> str:
    return quote(path)


def _plain(value: object) -> str:
    text = json.dumps(value) if isinstance(value, Mapping | list) else str(value)
    return html.escape(text)


def _clock(seconds: float) -> str:
    """Write 75.3 as "1 min 15 s" and 7.5 as "7.5 s"."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"
