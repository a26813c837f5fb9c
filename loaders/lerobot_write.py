"""From Episodes to a LeRobot v3 root without video.

Columns and info.json come from one table (``lerobot_columns``), so they cannot disagree. Data files
are written as episodes arrive; the root appears, whole, when the last of them is written.
"""

import json
import os
import shutil
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import MODEL_FPS, SIDES
from mint_hub.loaders import lerobot_codec, lerobot_files
from mint_hub.loaders.lerobot_columns import (
    COUNTERS,
    Column,
    Dialect,
    LeRobotError,
    columns_of,
)
from mint_hub.loaders.lerobot_read import OURS
from mint_hub.loaders.lerobot_text import Tasks
from mint_hub.loaders.schema import SCHEMA_VERSION, Episode
from mint_hub.loaders.stats import QUANTILES, Sketch

TIME_TOLERANCE_S: Final = 1e-4
"""How far frame times may be from an even rate, as LeRobot itself tolerates."""

_BLOCK_FRAMES: Final = 8192
_CHUNK_FILES: Final = 1000


@dataclass(frozen=True)
class LeRobotReport:
    """What was written."""

    folder: Path
    dialect: Dialect
    num_episodes: int
    num_frames: int
    num_files: int
    num_tasks: int


def to_lerobot(
    episodes: Iterable[Episode],
    folder: str | os.PathLike[str],
    dialect: Dialect = "camera",
    fps: float = MODEL_FPS,
    *,
    extra: bool = False,
    file_bytes: int = 100 << 20,
) -> LeRobotReport:
    """Write a LeRobot v3 root that ``from_lerobot`` and the ``lerobot`` package read.

    Episodes are numbered from 0 as they come. What LeRobot has no column for (key, text sides,
    image size, meta) travels as JSON in the column ``mint_episode`` of meta/episodes. Values of
    absent hands are ``hand_state.absent``. stats.json covers the label columns, those of a hand
    only where it is present.

    Args:
        episodes: any iterable; taken one at a time.
        folder: of the new root; appears complete or not at all.
        dialect: "camera" is exact; "world" goes through matrices (round trip to 1e-6).
        fps: of every episode.
        extra: also write timestamp_s, presence_score and hand_filled, which the two dialects do
            not have; without it scores and filled are left out, and times must be even.
        file_bytes: data files are closed at the first episode past this size, uncompressed.

    Raises:
        LeRobotError: a ValueError: no episodes, a key twice, another frame rate, uneven times, or
            ``folder`` is not empty.

    """
    target = Path(folder)
    if dialect not in ("camera", "world"):
        raise LeRobotError(f"dialect: expected 'camera' or 'world', got {dialect!r}")
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise LeRobotError(f"{target}: expected a new or an empty folder, got one with files")
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(dir=target.parent, prefix=f".{target.name}.partial-"))
    try:
        writer = _Writer(partial / "root", dialect, float(fps), extra, file_bytes)
        try:
            for episode in episodes:
                writer.add(episode)
        finally:
            writer.close_files()
        report = writer.finish(target)
        os.replace(partial / "root", target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return report


class _Writer:
    """One root under way."""

    def __init__(
        self, root: Path, dialect: Dialect, fps: float, extra: bool, file_bytes: int
    ) -> None:
        self.root, self.fps, self.extra, self.file_bytes = root, fps, extra, file_bytes
        self.dialect: Dialect = dialect
        self.columns = columns_of(dialect, extra)
        self.frame_bytes = sum(np.dtype(c.dtype).itemsize * c.width for c in self.columns)
        self.tasks = Tasks()
        self.stats = _Stats(self.columns)
        self.keys: set[str] = set()
        self.num_frames = self.num_files = self.frames_in_file = 0
        self.waiting: list[dict[str, NDArray[Any]]] = []
        self.rows: list[dict[str, Any]] = []
        self.frames: Any = None

    def add(self, episode: Episode) -> None:
        """Take in an episode."""
        number = len(self.keys)
        _check_times(episode, self.fps, self.extra)
        if episode.key in self.keys:
            raise LeRobotError(f"key: expected each once, got {episode.key} twice")
        self.keys.add(episode.key)
        full = self.frames_in_file * self.frame_bytes >= self.file_bytes
        if self.frames is None or full:
            self._next_file()
        text = self.tasks.rows(episode)
        arrays = {**self._counters(episode, number, text), **self._labels(episode)}
        arrays = {c.name: _typed(c, arrays[c.name]) for c in self.columns}
        self.rows.append(self._row(episode, number, text))
        self.waiting.append(arrays)
        self.frames_in_file += episode.num_frames
        self.num_frames += episode.num_frames
        if sum(len(a["index"]) for a in self.waiting) >= _BLOCK_FRAMES:
            self._flush()

    def finish(self, target: Path) -> LeRobotReport:
        """Write what is known only at the end."""
        if not self.keys:
            raise LeRobotError("episodes: expected at least one, got none")
        meta = self.root / "meta"
        _write_tasks(self.tasks.numbers, self.root / lerobot_files.TASKS)
        _write_json(meta / "stats.json", self.stats.to_dict())
        _write_json(self.root / lerobot_files.INFO, self._info())
        return LeRobotReport(
            folder=target,
            dialect=self.dialect,
            num_episodes=len(self.keys),
            num_frames=self.num_frames,
            num_files=self.num_files,
            num_tasks=len(self.tasks.numbers),
        )

    def close_files(self) -> None:
        """Close the data file under way and write the rows of its episodes."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        if self.frames is None:
            return
        self._flush()
        self.frames.close()
        self.frames = None
        path = self._path("meta/episodes")
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.Table.from_pylist(self.rows, schema=_row_schema()), path)
        self.rows = []

    # ------------------------------------------------------------------------------------ private

    def _next_file(self) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        self.close_files()
        self.num_files += 1
        self.frames_in_file = 0
        path = self._path("data")
        path.parent.mkdir(parents=True, exist_ok=True)
        schema = pa.schema([(c.name, _arrow_type(c)) for c in self.columns])
        repeating: Any = [c.name for c in COUNTERS]
        self.frames = pq.ParquetWriter(path, schema, use_dictionary=repeating)

    def _path(self, folder: str) -> Path:
        chunk, file = divmod(self.num_files - 1, _CHUNK_FILES)
        return self.root / folder / f"chunk-{chunk:03d}" / f"file-{file:03d}.parquet"

    def _flush(self) -> None:
        """Write the waiting episodes as one row group."""
        import pyarrow as pa

        if not self.waiting:
            return
        block = {c.name: np.concatenate([a[c.name] for a in self.waiting]) for c in self.columns}
        self.waiting = []
        self.stats.add(block)
        arrays: list[Any] = []
        for column in self.columns:
            flat: Any = pa.array(block[column.name].reshape(-1))
            if column.width > 1:
                flat = pa.FixedSizeListArray.from_arrays(flat, column.width)
            arrays.append(flat)
        self.frames.write_table(pa.Table.from_arrays(arrays, schema=self.frames.schema))

    def _counters(self, episode: Episode, number: int, text: dict[str, Any]) -> dict[str, Any]:
        frames = np.arange(episode.num_frames)
        return {
            "index": self.num_frames + frames,
            "episode_index": np.full(episode.num_frames, number),
            "frame_index": frames,
            "task_index": text["task_index"],
            "main_type": text["main_type"],
            "timestamp": frames / self.fps,
            "state_mask": episode.presence,
        }

    def _labels(self, episode: Episode) -> dict[str, Any]:
        labels = lerobot_codec.encode(self.dialect, episode)
        score, filled = episode.presence_score, episode.filled
        labels["timestamp_s"] = episode.timestamps_s
        labels["presence_score"] = episode.presence if score is None else score
        labels["hand_filled"] = np.zeros_like(episode.presence) if filled is None else filled
        return labels

    def _row(self, episode: Episode, number: int, text: dict[str, Any]) -> dict[str, Any]:
        chunk, file = divmod(self.num_files - 1, _CHUNK_FILES)
        kept = {
            "timestamp_s": True,
            "presence_score": episode.presence_score is not None,
            "hand_filled": episode.filled is not None,
        }
        ours = {
            "key": episode.key,
            "image_size_hw": list(episode.image_size_hw),
            "start_s": float(episode.timestamps_s[0]),
            "text": [segment.to_dict() for segment in episode.text],
            "meta": episode.meta,
            "extra": [name for name, there in kept.items() if there and self.extra],
            "schema_version": SCHEMA_VERSION,
        }
        return {
            "episode_index": number,
            "length": episode.num_frames,
            "tasks": text["tasks"],
            "atomic_segments": text["atomic_segments"],
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": self.num_frames,
            "dataset_to_index": self.num_frames + episode.num_frames,
            "meta/episodes/chunk_index": chunk,
            "meta/episodes/file_index": file,
            OURS: json.dumps(ours, sort_keys=True, ensure_ascii=False),
        }

    def _info(self) -> dict[str, Any]:
        return {
            "codebase_version": "v3.0",
            "robot_type": "ego_hand",
            "total_episodes": len(self.keys),
            "total_frames": self.num_frames,
            "total_tasks": len(self.tasks.numbers),
            "total_videos": 0,
            "chunks_size": _CHUNK_FILES,
            "data_files_size_in_mb": max(1, self.file_bytes >> 20),
            "video_files_size_in_mb": 200,
            "fps": int(self.fps) if self.fps.is_integer() else self.fps,
            "splits": {"train": f"0:{len(self.keys)}"},
            "data_path": lerobot_files.DATA_PATH,
            "video_path": None,
            "features": {c.name: c.feature() for c in self.columns},
            "hand_frame": self.dialect,
        }


class _Stats:
    """Statistics of the label columns."""

    def __init__(self, columns: Iterable[Column]) -> None:
        self.sketches = {
            c.name: Sketch(c.width) for c in columns if c.dtype.startswith("float") and c.width > 1
        }

    def add(self, block: dict[str, NDArray[Any]]) -> None:
        present = block["state_mask"]
        for name, sketch in self.sketches.items():
            rows = block[name]
            if name == "observation.state":
                rows = rows[present.all(axis=-1)]
            for hand, side in enumerate(SIDES):
                if name.startswith(f"{side}_"):
                    rows = rows[present[:, hand]]
            sketch.add(rows)

    def to_dict(self) -> dict[str, Any]:
        return {name: _summary(sketch) for name, sketch in self.sketches.items()}


def _summary(sketch: Sketch) -> dict[str, list[float]]:
    """LeRobot's statistics of a feature; zeros, and a count of 0, where nothing was seen."""
    nothing = np.zeros_like(sketch.mean)
    seen = sketch.count > 0
    numbers = {
        "min": sketch.min if seen else nothing,
        "max": sketch.max if seen else nothing,
        "mean": sketch.mean,
        "std": np.sqrt(sketch.squares / max(1, sketch.count)),
        **{f"q{round(100 * q):02d}": sketch.quantile(q) if seen else nothing for q in QUANTILES},
    }
    return {**{name: x.tolist() for name, x in numbers.items()}, "count": [sketch.count]}


def _check_times(episode: Episode, fps: float, extra: bool) -> None:
    times = episode.timestamps_s
    apart = np.abs(times - times[0] - np.arange(len(times)) / fps)
    limit = 0.5 / fps if extra else TIME_TOLERANCE_S
    if abs(episode.fps - fps) > 1e-3 * fps or apart.max() > limit:
        raise LeRobotError(
            f"timestamps_s: expected {fps:g} frames a second, each within {limit:.4g} s of it, got "
            f"{episode.fps:g} and {apart.max():.4g} s at frame {int(apart.argmax())} "
            f"(episode {episode.key}): resample it" + ("" if extra else ", or pass extra=True")
        )


def _typed(column: Column, numbers: Any) -> NDArray[Any]:
    shape = (-1,) if column.width == 1 else (-1, column.width)
    return np.ascontiguousarray(numbers, np.dtype(column.dtype)).reshape(shape)


def _arrow_type(column: Column) -> Any:
    import pyarrow as pa

    kind = pa.from_numpy_dtype(np.dtype(column.dtype))
    return kind if column.width == 1 else pa.list_(kind, column.width)


def _row_schema() -> Any:
    import pyarrow as pa

    numbers = ("atomic_index", "task_index", "start_frame", "end_frame")
    segment = pa.struct([(name, pa.int64()) for name in numbers])
    kinds = {"tasks": pa.list_(pa.string()), "atomic_segments": pa.list_(segment)}
    names = (
        *("episode_index", "length", "tasks", "atomic_segments", "data/chunk_index"),
        *("data/file_index", "dataset_from_index", "dataset_to_index"),
        *("meta/episodes/chunk_index", "meta/episodes/file_index", OURS),
    )
    kinds[OURS] = pa.string()
    return pa.schema([(name, kinds.get(name, pa.int64())) for name in names])


def _write_tasks(numbers: dict[str, int], path: Path) -> None:
    """Write texts as the pandas index of ``task_index``, as the ``lerobot`` package wants them."""
    import pandas as pd

    texts = pd.Index(list(numbers), name=None, dtype="object")
    pd.DataFrame({"task_index": list(numbers.values())}, index=texts).to_parquet(path)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
