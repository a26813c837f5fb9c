"""Which episodes a reader shows: filters over ``episodes.parquet``, before any shard is opened.

The table is read a few thousand rows at a time and only in the columns that are asked for, so that
choosing among hundreds of thousands of episodes costs little memory.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import SIDES
from mint_hub.loaders.tar_layout import CorpusError

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.compute as pc
    from pyarrow import parquet

    Where = pc.Expression | Sequence[tuple[str, str, Any]] | Callable[[pa.Table], Any]
else:
    Where = Any

_ROWS: Final = 16_384
_ROW_COLUMN: Final = "row of the split"


@dataclass(frozen=True)
class Selection:
    """What an episode must be to be shown; None asks for nothing.

    Attributes:
        where: an expression of ``pyarrow.compute``; or conditions that all must hold, such as
            ``[("participant", "==", "P01"), ("fps", ">=", 30)]``; or a function from a table of
            some rows to a mask over them. Columns are those of ``episodes.parquet``.
        text: words, found in the text of any segment, whatever their case.
        source: one source, or several of which any will do.
        min_frames: fewest frames.
        presence: least share of frames, 0 to 1, in which the left and in which the right hand is
            there; one number holds for both hands.

    Raises:
        ValueError: a field is of another kind, or nothing can be as it says; names the field.

    """

    where: "Where | None" = None
    text: str | None = None
    source: str | Sequence[str] | None = None
    min_frames: int | None = None
    presence: float | tuple[float, float] | None = None

    def __post_init__(self) -> None:
        _check_words("text", self.text, several=False)
        _check_words("source", self.source, several=True)
        conditions: Any = self.where
        if isinstance(conditions, list | tuple):
            for one in conditions:
                triple = isinstance(one, list | tuple) and len(one) == 3
                if not triple or not isinstance(one[0], str):
                    raise ValueError(f"where: expected (column, op, value) each, got {one!r}")
        frames: Any = self.min_frames
        if frames is not None and (
            isinstance(frames, bool) or not isinstance(frames, int | np.integer) or frames < 0
        ):
            raise ValueError(f"min_frames: expected a whole number of at least 0, got {frames!r}")
        if self.presence is not None:
            _least_shares(self.presence)

    def __bool__(self) -> bool:
        """Whether anything is asked for."""
        return any(getattr(self, field.name) is not None for field in fields(self))

    def rows(self, path: Path) -> NDArray[np.int64]:
        """Return the rows of an ``episodes.parquet`` that are as asked for, ascending.

        Raises:
            ValueError: a condition is of no known kind, or its mask has another length.
            CorpusError: no parquet file, or a column that a condition names is missing.

        """
        import pyarrow as pa
        from pyarrow import parquet

        known: set[Any] = set()
        chosen: list[NDArray[np.int64]] = []
        try:
            with parquet.ParquetFile(path) as file:
                for table in _tables(file, self._columns(), path):
                    chosen.append(self._chosen(table))
                    if self.source is not None:
                        known.update(table["source"].unique().to_pylist())
        except (pa.ArrowException, OSError) as error:
            raise CorpusError(f"{path}: cannot select episodes: {error}") from error
        if unknown := [name for name in self._sources() if name not in known]:
            there = sorted(name for name in known if name is not None)
            raise ValueError(f"source: expected some of {there}, got {unknown[0]!r} ({path})")
        return np.concatenate([np.empty(0, np.int64), *chosen])

    def _sources(self) -> list[str]:
        if self.source is None:
            return []
        return [self.source] if isinstance(self.source, str) else list(self.source)

    def _columns(self) -> list[str] | None:
        """Columns to read; None: all, since an expression or a function may name any."""
        names = {"num_frames"}
        if self.where is not None:
            if not isinstance(self.where, list | tuple):
                return None
            names.update(condition[0] for condition in self.where)
        names.update(name for name in ("text", "source") if getattr(self, name) is not None)
        if self.presence is not None:
            names.update(_PRESENCE)
        return sorted(names)

    def _chosen(self, table: "pa.Table") -> NDArray[np.int64]:
        import pyarrow.compute as pc

        for mask in self._masks():
            table = table.filter(mask)
        if self.text is not None:
            table = table.filter(_mentions(table, self.text))
        if callable(self.where) and not isinstance(self.where, pc.Expression):
            mask = np.asarray(self.where(table.drop_columns([_ROW_COLUMN])), bool)
            if mask.shape != (len(table),):
                raise ValueError(f"where: expected a mask ({len(table)},), got {mask.shape}")
            return table[_ROW_COLUMN].to_numpy()[mask]
        return table[_ROW_COLUMN].to_numpy()

    def _masks(self) -> "list[pc.Expression]":
        import pyarrow.compute as pc
        from pyarrow import parquet

        masks: list[pc.Expression] = []
        if isinstance(self.where, pc.Expression):
            masks.append(self.where)
        elif isinstance(self.where, list | tuple) and self.where:
            masks.append(parquet.filters_to_expression(list(self.where)))
        elif self.where is not None and not callable(self.where) and self.where:
            raise ValueError(
                "where: expected an expression, a list of (column, op, value) or a function, "
                f"got {self.where!r}"
            )
        if self.min_frames is not None:
            masks.append(pc.field("num_frames") >= self.min_frames)
        if self.source is not None:
            masks.append(pc.field("source").isin(self._sources()))
        if self.presence is not None:
            least = _least_shares(self.presence)
            masks += [pc.field(n) >= p for n, p in zip(_PRESENCE, least, strict=True)]
        return masks


def _check_words(name: str, value: Any, several: bool) -> None:
    """Refuse what is neither None nor text, nor ``several`` of it."""
    many = several and isinstance(value, Sequence) and not isinstance(value, str | bytes)
    words: list[Any] = list(value) if many else [] if value is None else [value]
    if not all(isinstance(word, str) and word for word in words) or (many and not words):
        expected = "text, or several texts" if several else "text"
        raise ValueError(f"{name}: expected {expected}, got {value!r}")


def _least_shares(presence: Any) -> list[float]:
    """Return the least share of the left and of the right hand."""
    pair = list(presence) if isinstance(presence, tuple | list | np.ndarray) else [presence] * 2
    for share in pair:
        number = isinstance(share, int | float | np.number) and not isinstance(share, bool)
        if len(pair) != 2 or not number or not 0 <= share <= 1:
            raise ValueError(
                f"presence: expected a share of frames from 0 to 1, or one for the left and one "
                f"for the right hand, got {presence!r}"
            )
    if len(pair) != 2:
        raise ValueError(f"presence: expected one share, or one a hand, got {presence!r}")
    return np.asarray(pair, np.float32).tolist()


_PRESENCE: Final = tuple(f"presence_{side}" for side in SIDES)


def _tables(
    file: "parquet.ParquetFile", columns: list[str] | None, path: Path
) -> Iterator["pa.Table"]:
    """Yield a file's rows as tables of some thousands, with their numbers in a column."""
    import pyarrow as pa

    have = file.schema_arrow.names
    if columns and (missing := sorted(set(columns) - set(have))):
        raise CorpusError(f"{path}: expected column {missing[0]}, got {have}")
    start = 0
    for batch in file.iter_batches(_ROWS, columns=columns):
        table = pa.Table.from_batches([batch])
        rows = np.arange(start, start + len(table), dtype=np.int64)
        start += len(table)
        yield table.append_column(_ROW_COLUMN, pa.array(rows))


def _mentions(table: "pa.Table", words: str) -> "pa.Array":
    """Return which rows have the words in the text of a segment."""
    import pyarrow as pa
    import pyarrow.compute

    pc: Any = pyarrow.compute  # its functions are made at import, so type checkers miss them
    segments = table["text"].combine_chunks()
    texts = pc.struct_field(pc.list_flatten(segments), "text")
    found = pc.match_substring(texts, words, ignore_case=True).to_numpy(zero_copy_only=False)
    owners = pc.list_parent_indices(segments).to_numpy(zero_copy_only=False)
    mask = np.zeros(len(table), bool)
    mask[owners[found.astype(bool)]] = True
    return pa.array(mask)
