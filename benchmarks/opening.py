"""Opening a reader over the whole corpus: seconds, and memory beyond that of the imports.

    python benchmarks/opening.py [--episodes 560649]

The index, the table of episodes and the manifest are synthesised at the corpus's size; the shards
are empty files of the right length. Every way of opening runs in a process of its own.
"""

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from _report import write_report

from mint_hub.loaders.index import ROW, episodes_schema, write_rows
from mint_hub.loaders.manifest import (
    EPISODES,
    INDEX,
    MANIFEST,
    Manifest,
    ShardRecord,
    record_of,
    write_sealed,
)
from mint_hub.loaders.members import MEMBERS, ROT6D, TRAJ, member_names

SHARD_BYTES, BLOCK, JSON_BYTES, ROWS_A_GROUP = 64 << 20, 512, 1536, 700
WORDS = ["open", "close", "take", "put", "pour", "wash", "drawer", "cup", "plate", "jar", "lid"]
SOURCES = ("ego4d", "epic", "egodex")
WAYS = {
    "no_filter": "{}",
    "source": "{'source': 'epic'}",
    "text": "{'text': 'pour'}",
    "frames_and_presence": "{'min_frames': 100, 'presence': 0.5}",
    "function": "{'where': lambda table: table['num_frames'].to_numpy() > 300}",
}
OPENING = """
import json, sys, time
import psutil, pyarrow.compute, pyarrow.parquet
from mint_hub.loaders.reader import CorpusReader
memory = lambda: psutil.Process().memory_info().rss / 2**20
before, start = memory(), time.perf_counter()
reader = CorpusReader(sys.argv[1], "all", "train", **eval(sys.argv[2]))
opened = {"open_s": round(time.perf_counter() - start, 3), "added_mib": round(memory() - before, 1)}
reader.key(0)
with_keys = round(memory() - before, 1)
print(json.dumps({"episodes": len(reader), **opened, "added_mib_with_keys": with_keys}))
"""


def synthesise(split: Path, count: int) -> None:
    """Write everything of a split but the contents of its shards."""
    split.mkdir(parents=True)
    rng = np.random.default_rng(0)
    rows = np.zeros(count, ROW)
    rows["num_frames"] = np.clip(rng.gamma(2, 98, count), 16, 2000)
    row_bytes = {m.name: m.width * np.dtype(m.dtype).itemsize for m in MEMBERS}
    size = np.full(count, JSON_BYTES, np.int64)
    for name in (TRAJ, ROT6D):
        data = 128 + rows["num_frames"].astype(np.int64) * row_bytes[name]
        size += BLOCK + -(-data // BLOCK) * BLOCK
    ends = np.cumsum(size)
    rows["shard"], rows["size"], rows["arrays"] = ends // SHARD_BYTES, size, JSON_BYTES
    starts = np.flatnonzero(np.diff(rows["shard"], prepend=-1))
    rows["offset"] = ends - size - (ends - size)[starts][rows["shard"]]
    write_rows(split / INDEX, rows)
    write_episodes(split / EPISODES, rows, rng)
    shards: list[ShardRecord] = []
    for number, group in enumerate(np.split(size, starts[1:])):
        name, length = f"all-train-{number:05d}.tar", int(group.sum()) + 2 * BLOCK
        with open(split / name, "wb") as file:
            file.truncate(length)
        shards.append(ShardRecord(name, length, "0" * 64, len(group)))
    files = tuple(record_of(split / name) for name in (INDEX, EPISODES))
    frames, members = int(rows["num_frames"].sum()), member_names()
    made = Manifest("all", "train", "compact", members, frames, tuple(shards), files, {})
    write_sealed(split / MANIFEST, made.to_dict())


def write_episodes(path: Path, rows: np.ndarray, rng: np.random.Generator) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    schema = episodes_schema()
    empty = dict.fromkeys(schema.names)
    with parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        for start in range(0, len(rows), ROWS_A_GROUP):
            group = range(start, min(start + ROWS_A_GROUP, len(rows)))
            records = [{**empty, **episode_record(i, rows[i], rng)} for i in group]
            writer.write_table(pa.Table.from_pylist(records, schema))


def episode_record(i: int, row: Any, rng: np.random.Generator) -> dict[str, Any]:
    words = rng.integers(0, len(WORDS), (2, 8))
    text = [
        {
            "id": str(k),
            "text": " ".join(WORDS[w] for w in line),
            "side": "left",
            "start": 0,
            "end": 8,
        }
        for k, line in enumerate(words.tolist())
    ]
    uid = hashlib.sha256(str(i // 20).encode()).hexdigest()[:32]
    return {
        "key": f"{SOURCES[i % 3]}-{uid[:12]}-{i:06d}",
        **{"schema_version": 1, "format": "compact", "fps": 30.0, "start_s": i * 0.1},
        **{"image_size_hw": [1080, 1920], "text": text, "source": SOURCES[i % 3], "uid": uid},
        **{"domain": "daily", "scale_status": "enlarged", "crc32": int(rng.integers(2**32))},
        **{"presence_left": 0.9, "presence_right": 0.8, "meta": json.dumps({"number": i})},
        **{name: int(row[name]) for name in ("num_frames", "shard", "offset", "size")},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=560_649)
    count = parser.parse_args().episodes
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        synthesise(Path(folder) / "all" / "train", count)
        for way, options in WAYS.items():
            command = [sys.executable, "-c", OPENING, folder, options]
            answer = subprocess.run(command, check=True, capture_output=True, text=True)
            results[way] = json.loads(answer.stdout)
            print(way, results[way])
    print(write_report("opening", results, {"episodes": count}))


if __name__ == "__main__":
    main()
