# ruff: noqa: D101, D102 (what readers do is said once, below)
"""Reading the corpus: frames a second in order, random 16-frame windows a second.

    python benchmarks/loading.py [--gb 1] [--seconds 15] [--folder KEEP]

One run, one process, one corpus of synthetic trajectories in a warm page cache. Every reader hands
over the same two arrays of each episode or window, and every 32-bit word of them is added up within
the timing, so nothing is lazy; the sums in order are compared with ours. Readers, all but the first
three slow enough to be stopped after ``--seconds``:

    ours          CorpusReader.iter_arrays, opened anew in each pass, so that its page faults
                  count; headers are checked, numbers are not, as with webdataset
    ours, checked whole Episodes in order, every number checked: far slower than arrays alone
    raw           the bytes of the shards, read and summed, without any parsing; windows by pread
    webdataset    the same shards; windows: one of each streamed sample, as it has no random access
    datasets      the same shards with declared features, map-style and streaming (windows likewise)
    lerobot       the same numbers as LeRobot v3 parquet, a row a frame, asked for as lerobot 0.4
                  does: key by key, by a list of rows; with the version of `datasets` tried, each
                  key then costs its whole column, so the next one is the fair comparison
    parquet rows  the same files read as they are fastest there: one slice of rows, then its keys
"""

import argparse
import io
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
from _report import write_report

from mint_hub.geometry import hand_state
from mint_hub.loaders.members import ROT6D, TRAJ, member
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.shards import write_corpus

LENGTH, BATCH, SEED, PASSES = 16, 256, 0, 5
MEAN_FRAMES, BYTES_A_FRAME, BASE_FRAMES = 197, 466, 4096
NAMES = (TRAJ, ROT6D)
Pair = tuple[np.ndarray, np.ndarray]


# ----------------------------------------------------------------------------- the data


class Trajectories:
    """Any number of episodes: stretches of one long random walk, each with noise of its own."""

    def __init__(self, num_frames: int) -> None:
        rng = np.random.default_rng(SEED)
        lengths = np.clip(
            rng.gamma(2, MEAN_FRAMES / 2, 2 * num_frames // MEAN_FRAMES), LENGTH, 2000
        )
        self.lengths = lengths.astype(int)[: np.searchsorted(np.cumsum(lengths), num_frames) + 1]
        shape = (BASE_FRAMES, 2)
        state = np.array(hand_state.absent(shape), np.float32)
        rotations = state[..., hand_state.ORIENTATION.start : hand_state.JOINT_ROTATIONS.stop]
        rows = rng.normal(size=(*shape, 16, 2, 3))
        rows[..., 0, :] /= np.linalg.norm(rows[..., 0, :], axis=-1, keepdims=True)
        rows[..., 1, :] -= (rows[..., 0, :] * rows[..., 1, :]).sum(-1, keepdims=True) * rows[
            ..., 0, :
        ]
        rows[..., 1, :] /= np.linalg.norm(rows[..., 1, :], axis=-1, keepdims=True)
        rotations[:] = rows.reshape(*shape, 96)
        state[..., hand_state.TRANSLATION] = np.cumsum(rng.normal(0, 0.003, (*shape, 3)), axis=0)
        self.state = state
        self.T = np.tile(np.eye(4), (BASE_FRAMES, 1, 1))
        self.T[:, :3, 3] = np.cumsum(rng.normal(0, 0.01, (BASE_FRAMES, 3)), axis=0)

    def __len__(self) -> int:
        return len(self.lengths)

    def __getitem__(self, i: int) -> Episode:
        rng = np.random.default_rng([SEED, i])
        length = int(self.lengths[i])
        start = int(rng.integers(0, BASE_FRAMES - length))
        part = slice(start, start + length)
        state = self.state[part].copy()
        state[..., hand_state.TRANSLATION] += rng.normal(0, 0.1, 3).astype(np.float32)
        return Episode(
            key=f"synthetic-{i:08d}",
            timestamps_s=np.arange(length) / 30,
            T_camera_from_world=self.T[part],
            fov_vh_rad=np.full((length, 2), 1.2),
            hand_state=state,
            presence=np.ones((length, 2), bool),
            image_size_hw=(1080, 1920),
            meta={"source": "synthetic", "uid": f"video-{i // 20}", "fps": 30.0},
        )


def write_parquet(reader: CorpusReader, folder: Path) -> None:
    """Write the numbers as LeRobot v3 data files: float32, a row a frame, a column a quantity."""
    import pyarrow as pa
    from pyarrow import parquet

    folder.mkdir(parents=True)
    writer, rows, number = None, 0, 0
    for i, arrays in reader.iter_arrays():
        columns = {"episode_index": pa.array(np.full(len(arrays[TRAJ]), i))}
        for name, part in quantities(arrays[TRAJ], arrays[ROT6D]).items():
            flat = pa.array(np.ascontiguousarray(part, np.float32).ravel())
            columns[name] = pa.FixedSizeListArray.from_arrays(flat, part.shape[1])
        table = pa.table(columns)
        if writer is None:
            path = folder / f"file-{number:03d}.parquet"
            writer, number = parquet.ParquetWriter(path, table.schema), number + 1
        writer.write_table(table)
        rows += len(table)
        if rows > 100_000:
            writer.close()
            writer, rows = None, 0
    if writer is not None:
        writer.close()


def quantities(traj: np.ndarray, rot6d: np.ndarray) -> dict[str, np.ndarray]:
    pairs = ((TRAJ, traj), (ROT6D, rot6d))
    return {c: a[:, s] for name, a in pairs for c, s in member(name).slices.items()}


# -------------------------------------------------------------------------- the readers


class Ours:
    """Opened anew in every pass."""

    def __init__(self, folder: Path) -> None:
        self.reader = CorpusReader(folder, "all", "train")

    def in_order(self) -> Iterator[Pair]:
        for _, arrays in self.reader.iter_arrays():
            yield arrays[TRAJ], arrays[ROT6D]

    def windows(self, rng: np.random.Generator) -> Iterator[Pair]:
        while True:
            batch = self.reader.random_windows(BATCH, LENGTH, rng)
            yield batch.arrays[TRAJ], batch.arrays[ROT6D]


class OursChecked(Ours):
    """Whole checked Episodes, arrays encoded anew by nobody: the typed way."""

    def in_order(self) -> Iterator[Pair]:
        for episode in self.reader:
            yield np.ascontiguousarray(episode.fov_vh_rad), episode.hand_state

    windows = None


class Raw(Ours):
    """No parsing at all: what the disk cache and memory allow."""

    def in_order(self) -> Iterator[Pair]:
        buffer = np.empty(1 << 20, np.uint32)
        empty = np.empty(0, np.uint32)
        for shard in shard_paths(self.reader):
            with open(shard, "rb", buffering=0) as file:
                while size := file.readinto(buffer.data):  # type: ignore[arg-type]
                    yield buffer[: size // 4], empty

    def windows(self, rng: np.random.Generator) -> Iterator[Pair]:
        files = [os.open(path, os.O_RDONLY) for path in shard_paths(self.reader)]
        places = {rows.name: (rows.row_bytes, rows.at) for rows in self.reader._layout}
        out = [np.empty(LENGTH * places[name][0] // 4, np.uint32) for name in NAMES]
        try:
            for i, start in draws(self.reader.num_frames, rng):
                for array, (row, at) in zip(out, places.values(), strict=True):
                    os.preadv(files[self.reader._shard[i]], [array.data], int(at[i]) + start * row)
                yield out[0], out[1]
        finally:
            for file in files:
                os.close(file)


class Streamed:
    """A reader without random access: its windows are one a streamed sample."""

    def in_order(self) -> Iterator[Pair]:
        raise NotImplementedError

    def windows(self, rng: np.random.Generator) -> Iterator[Pair]:
        while True:
            for traj, rot6d in self.in_order():
                start = rng.integers(0, len(traj) - LENGTH + 1)
                window = slice(start, start + LENGTH)
                yield traj[window].copy(), rot6d[window].copy()


class WebDataset(Streamed):
    def __init__(self, folder: Path) -> None:
        self.paths = [str(p) for p in shard_paths(CorpusReader(folder, "all", "train"))]

    def in_order(self) -> Iterator[Pair]:
        import webdataset

        def load(data: bytes) -> np.ndarray:
            return np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)

        for sample in webdataset.WebDataset(self.paths, shardshuffle=False, empty_check=False):
            yield load(sample[TRAJ]), load(sample[ROT6D])


class DatasetsStreaming(Streamed):
    def __init__(self, folder: Path, cache: Path, streaming: bool = True) -> None:
        import datasets

        from mint_hub.loaders.derived import dataset_features

        datasets.disable_progress_bars()
        paths = [str(p) for p in shard_paths(CorpusReader(folder, "all", "train"))]
        features, options = dataset_features(), {"streaming": streaming, "cache_dir": str(cache)}
        made = datasets.load_dataset(
            "webdataset", data_files=paths, split="train", features=features, **options
        )
        self.rows: Any = made.select_columns(list(NAMES)).with_format("numpy")

    def in_order(self) -> Iterator[Pair]:
        for row in self.rows:
            yield row[TRAJ], row[ROT6D]


class DatasetsMapStyle(DatasetsStreaming):
    def __init__(self, folder: Path, cache: Path) -> None:
        super().__init__(folder, cache, streaming=False)
        self.num_frames = CorpusReader(folder, "all", "train").num_frames

    def windows(self, rng: np.random.Generator) -> Iterator[Pair]:
        for i, start in draws(self.num_frames, rng):
            row = self.rows[i]
            window = slice(start, start + LENGTH)
            yield row[TRAJ][window].copy(), row[ROT6D][window].copy()


class ParquetRows:
    """A frame a row; a window is one slice of rows."""

    def __init__(self, folder: Path, cache: Path) -> None:
        import datasets

        reader = CorpusReader(folder, "all", "train")
        if not (cache / "lerobot").exists():
            write_parquet(reader, cache / "lerobot")
        self.num_frames = reader.num_frames
        self.first = np.cumsum(self.num_frames) - self.num_frames
        paths = sorted(str(p) for p in (cache / "lerobot").glob("*.parquet"))
        made: Any = datasets.load_dataset(
            "parquet", data_files=paths, split="train", cache_dir=str(cache / "arrow")
        )
        self.rows = made.with_format("torch")
        self.keys = [name for name in made.column_names if name != "episode_index"]

    def _query(self, first: int, count: int) -> Pair:
        import torch

        rows = self.rows[first : first + count]
        parts = [rows[key] for key in self.keys]
        names = len(member(TRAJ).columns)
        return torch.cat(parts[:names], 1).numpy(), torch.cat(parts[names:], 1).numpy()

    def in_order(self) -> Iterator[Pair]:
        for first, count in zip(self.first.tolist(), self.num_frames.tolist(), strict=True):
            yield self._query(first, count)

    def windows(self, rng: np.random.Generator) -> Iterator[Pair]:
        for i, start in draws(self.num_frames, rng):
            yield self._query(int(self.first[i]) + start, LENGTH)


class LeRobot(ParquetRows):
    """The same files as lerobot 0.4 asks for a window of them: key by key, by a list of rows."""

    def _query(self, first: int, count: int) -> Pair:
        import torch

        indices = list(range(first, first + count))
        parts = [self.rows[key][indices] for key in self.keys]
        names = len(member(TRAJ).columns)
        return torch.cat(parts[:names], 1).numpy(), torch.cat(parts[names:], 1).numpy()


def shard_paths(reader: CorpusReader) -> list[Path]:
    return [reader._files.path(shard) for shard in reader.manifest.shards]


def draws(num_frames: np.ndarray, rng: np.random.Generator) -> Iterator[tuple[int, int]]:
    while True:
        i = int(rng.integers(len(num_frames)))
        yield i, int(rng.integers(num_frames[i] - LENGTH + 1))


# --------------------------------------------------------------------------- the timing


def word_sum(array: np.ndarray) -> int:
    """Sum of the array's 32-bit words, modulo 2**32."""
    words = np.ascontiguousarray(array).reshape(-1).view(np.uint32)
    return int(np.add.reduce(words, dtype=np.uint32))


def timed_in_order(open_reader: Callable[[], Any], seconds: float) -> dict[str, Any]:
    """Read until the end, or as long as allowed."""
    start = perf_counter()
    frames = episodes = trajectories = other = 0
    for traj, rot6d in open_reader().in_order():
        trajectories = (trajectories + word_sum(traj)) % 2**32
        other += word_sum(rot6d)
        frames, episodes = frames + len(traj), episodes + 1
        if perf_counter() - start > seconds:
            break
    taken = perf_counter() - start
    return {"frames_s": frames / taken, "episodes": episodes, "sum": trajectories, "s": taken}


def timed_windows(open_reader: Callable[[], Any], seconds: float, most: int) -> float:
    """Return windows a second."""
    start, count = perf_counter(), 0
    for traj, rot6d in open_reader().windows(np.random.default_rng(SEED)):
        word_sum(traj), word_sum(rot6d)
        count += len(traj) if traj.ndim == 3 else 1
        if count >= most or perf_counter() - start > seconds:
            break
    return count / (perf_counter() - start)


def measure(folder: Path, cache: Path, seconds: float) -> dict[str, dict[str, Any]]:
    reader = CorpusReader(folder, "all", "train")
    sums = np.cumsum([word_sum(a[TRAJ]) for _, a in reader.iter_arrays()], dtype=np.uint64) % 2**32
    total = int(reader.num_frames.sum())
    slow = {
        "datasets_map_style": DatasetsMapStyle(folder, cache),
        "datasets_streaming": DatasetsStreaming(folder, cache),
        "parquet_rows": ParquetRows(folder, cache),
        "lerobot_parquet": LeRobot(folder, cache),
    }
    makers: dict[str, Callable[[], Any]] = {
        "raw": lambda: Raw(folder),
        "ours": lambda: Ours(folder),
        "ours_checked_episodes": lambda: OursChecked(folder),
        "webdataset": lambda: WebDataset(folder),
        **{name: (lambda made=made: made) for name, made in slow.items()},
    }
    passes: dict[str, list[dict[str, Any]]] = {name: [] for name in makers}
    windows: dict[str, list[float]] = {name: [] for name in makers}
    for turn in range(PASSES):  # in turns, so that a busy moment of the machine meets every reader
        for name, make in makers.items():
            if turn and name not in ("raw", "ours", "webdataset"):
                continue
            result = timed_in_order(make, seconds)
            if name == "raw":
                result["frames_s"] = total / result["s"]
            elif name != "ours_checked_episodes" and result["sum"] != sums[result["episodes"] - 1]:
                raise SystemExit(f"{name} read other numbers than ours")
            passes[name].append(result)
            if make().windows is not None:
                windows[name].append(timed_windows(make, seconds / 2, 100_000))
            print(f"{name}: {result['frames_s']:,.0f} frames/s, {windows[name][-1:]} windows/s")
    return {
        name: {
            "frames_s": median(p["frames_s"] for p in passes[name]),
            "windows_s": median(windows[name]) if windows[name] else None,
            "passes": len(passes[name]),
        }
        for name in makers
    }


def rounded(results: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Numbers to four digits; ratios are made of those before."""
    return {
        name: {key: value and float(f"{value:.4g}") for key, value in entry.items()}
        for name, entry in results.items()
    }


def ratios(results: dict[str, dict[str, Any]]) -> dict[str, float]:
    def ratio(kind: str, other: str) -> float:
        return float(f"{results['ours'][kind] / results[other][kind]:.4g}")

    return {
        "windows_over_datasets_map_style": ratio("windows_s", "datasets_map_style"),
        "windows_over_lerobot_parquet": ratio("windows_s", "lerobot_parquet"),
        "windows_over_parquet_rows": ratio("windows_s", "parquet_rows"),
        "in_order_over_webdataset": ratio("frames_s", "webdataset"),
        "in_order_over_raw": ratio("frames_s", "raw"),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gb", type=float, default=1.0, help="size of the corpus, 10**9 bytes")
    parser.add_argument("--seconds", type=float, default=15.0, help="most for one slow reading")
    parser.add_argument("--folder", type=Path, help="keep the corpus here, or read the one there")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder, cache = options.folder or Path(scratch) / "corpus", Path(scratch) / "cache"
        made = Trajectories(int(options.gb * 1e9 / BYTES_A_FRAME))
        start, written = perf_counter(), None
        if not (folder / "all" / "train").exists():
            write_corpus(made, folder, "all", "train", num_procs=2)
            written = perf_counter() - start
        manifest = CorpusReader(folder, "all", "train").manifest
        results = measure(folder, cache, options.seconds)
        shutil.rmtree(cache, ignore_errors=True)
        facts = {
            "bytes_a_frame": round(manifest.num_bytes / manifest.num_frames, 1),
            "make_and_write_frames_s_2_processes": written and round(manifest.num_frames / written),
            "ratios": ratios(results),
        }
    settings = {
        **{"gb": options.gb, "frames": manifest.num_frames, "episodes": manifest.num_episodes},
        **{"shards": len(manifest.shards), "window_frames": LENGTH, "batch": BATCH, "seed": SEED},
    }
    print(facts)
    print(write_report("loading", {**rounded(results), **facts}, settings))


if __name__ == "__main__":
    main()
