"""Where the episodes of a LeRobot root lie: 60 bytes each, checked before any frame is read."""

from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.loaders import lerobot_files
from mint_hub.loaders.lerobot_columns import Column, LeRobotError
from mint_hub.loaders.lerobot_files import Root

INDEX_COLUMNS: Final = tuple(
    Column(name, "int64", 1)
    for name in (
        *("episode_index", "length", "data/chunk_index", "data/file_index"),
        "dataset_from_index",
    )
)


def episode_index(root: Root) -> NDArray[Any]:
    """Where each episode lies: one record an episode, in the order of the data files.

    ``base`` is the smallest dataset_from_index of the data file: an episode's first row there is
    ``dataset_from_index - base``.
    """
    names = [c.name for c in INDEX_COLUMNS]
    parts: list[NDArray[Any]] = []
    for number, path in enumerate(root.episode_files()):
        with root.parquet(path) as file:
            _require_columns(root.name(path), names, file.schema_arrow.names)
            table = file.read(columns=names)
        part = np.zeros(len(table), [(n, "i8") for n in (*names, "base", "row")] + [("file", "i4")])
        try:
            for column in INDEX_COLUMNS:
                part[column.name] = lerobot_files.values(table, column)
        except LeRobotError as error:
            raise LeRobotError(f"{root.name(path)}: {error}") from None
        if (part["length"] < 1).any():
            raise LeRobotError(f"{root.name(path)}: length: expected at least 1, got less")
        part["file"], part["row"] = number, np.arange(len(part))
        parts.append(part)
    index = np.concatenate(parts)
    order = ["data/chunk_index", "data/file_index", "dataset_from_index"]
    index = index[np.argsort(index, order=order)]
    _, group = np.unique(index[order[:2]], return_inverse=True)
    index["base"] = index["dataset_from_index"][np.searchsorted(group, group)]
    twice = np.flatnonzero(np.diff(np.sort(index["episode_index"])) == 0)
    if twice.size:
        number = int(np.sort(index["episode_index"])[twice[0]])
        where = root.name(lerobot_files.EPISODES)
        raise LeRobotError(f"{where}: episode_index: expected each once, got {number} twice")
    return index


def _require_columns(where: str, needed: Iterable[str], got: Iterable[str]) -> None:
    present = list(got)
    if missing := [name for name in needed if name not in present]:
        raise LeRobotError(f"{where}: expected the columns {missing}, got only {present}")


def check_spans(
    where: str, part: NDArray[Any], starts: NDArray[Any], stops: NDArray[Any], num_rows: int
) -> None:
    """Refuse episodes, sorted by first row, that leave their data file or share rows of it."""
    late = np.flatnonzero(stops > num_rows)
    overlap = np.flatnonzero(starts[1:] < stops[:-1]) + 1
    for bad, what in ((late, f"within its {num_rows} rows"), (overlap, "after the one before it")):
        if bad.size:
            number, rows = part[bad[0]]["episode_index"], (int(starts[bad[0]]), int(stops[bad[0]]))
            raise LeRobotError(
                f"{where}, episode {number}: expected its frames {what}, got rows "
                f"{rows[0]} to {rows[1]} (dataset_from_index and length of meta/episodes)"
            )
