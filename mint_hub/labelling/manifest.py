"""The manifest of a run: one line of JSON for every change of state, the last one counts.

A row says, for a video (``clip`` empty) or a clip, which stage it is at and its state: pending,
running, done, failed (an error) or rejected (a judgement), the latter two with their reason. Only
the runner writes it, a line at a time; a line torn by a crash is ignored when it is read again.
"""

import json
import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final, Literal, Self

from mint_hub.loaders.atomic import replacing

State = Literal["pending", "running", "done", "failed", "rejected"]
FINAL: Final = frozenset({"done", "failed", "rejected"})
NAME: Final = "manifest.jsonl"


@dataclass(frozen=True)
class Row:
    """State of a video or a clip.

    Attributes:
        video, clip: keys; an empty clip is the video itself.
        stage: where it is.
        state: see the module.
        reason: why it failed or was rejected.
        seconds: wall time of the stage.
        attempt: 1 for the first try.
        time_s: when, seconds since 1970.

    """

    video: str
    clip: str
    stage: str
    state: State
    reason: str = ""
    seconds: float = 0.0
    attempt: int = 1
    time_s: float = 0.0


class Manifest:
    """The manifest file of a run, opened for adding; use as a context manager."""

    def __init__(self, path: Path) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._latest = {(row.video, row.clip): row for row in read(path)}
        self._compact()
        self._file = path.open("a", encoding="utf-8")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def add(self, row: Row) -> None:
        """Write a row; it is on its way to the disk when this returns."""
        stamped = replace(row, time_s=round(time.time(), 3))
        self._file.write(json.dumps(asdict(stamped)) + "\n")
        self._file.flush()
        if row.state in FINAL:
            os.fsync(self._file.fileno())
        self._latest[row.video, row.clip] = stamped

    def latest(self) -> dict[tuple[str, str], Row]:
        """Return the last row of every video and clip."""
        return dict(self._latest)

    def forget(self, video: str) -> None:
        """Drop what is known of a video that has to be done again."""
        self._file.close()
        self._latest = {k: row for k, row in self._latest.items() if k[0] != video}
        self._compact()
        self._file = self.path.open("a", encoding="utf-8")

    def _compact(self) -> None:
        with replacing(self.path) as temporary:
            lines = (json.dumps(asdict(row)) + "\n" for row in self._latest.values())
            temporary.write_text("".join(lines), encoding="utf-8")


def read(path: Path) -> Iterator[Row]:
    """Read the rows of a manifest, in order; an absent file has none."""
    if not path.is_file():
        return
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            yield Row(**json.loads(line))
        except (json.JSONDecodeError, TypeError):
            continue  # torn by a crash while it was written
