"""What a verb of the command line wrote a split from, so that the same command goes on anywhere.

``write_corpus`` goes on where an unfinished split stopped, and refuses one that is finished. A
command that writes several splits may stop after any of them: it has to pass over those that it
finished, and over no others. So before a split is begun, its arguments and a stamp of its inputs
are written beside it, as ``.<split>.origin.json``; nothing else reads that file, and a corpus is
whole without it. It holds no path of the machine but those that the user typed.
"""

import hashlib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from mint_hub.loaders.atomic import clear_left_over
from mint_hub.loaders.manifest import read_manifest, read_sealed, write_sealed
from mint_hub.loaders.tar_layout import SUFFIX, CorpusError

INPUTS: Final = "inputs"
_TIMES: Final = ("mtime", "LastModified", "last_modified", "created")
_IDENTITIES: Final = ("blob_id", "ETag", "etag", "sha256")


def begin(
    folder: str | os.PathLike[str], config: str, split: str, origin: Mapping[str, Any]
) -> bool:
    """Return whether the split is still to be written, after noting what it is written from.

    Args:
        folder: the corpus.
        config: name of the config.
        split: name of the split.
        origin: JSON-able arguments, with the stamp of the inputs under INPUTS. All have to be equal
            but ``sources``, how inputs are called, which are only told.

    Returns:
        False where the split is finished and was written from the same origin.

    Raises:
        CorpusError: it is finished, or has finished shards, from another origin, or nothing says
            from which; names both.

    """
    final = Path(folder) / config / split
    partial, note = final.with_name(f".{split}.partial"), final.with_name(f".{split}.origin.json")
    finished, begun = final.exists(), any((partial / "files").glob(f"*{SUFFIX}"))
    if finished or begun:
        _compare(final if finished else partial, note, origin, required=finished)
    if finished and not partial.exists():
        read_manifest(final)
        return False
    clear_left_over(note)
    write_sealed(note, origin)
    return True


def _compare(place: Path, note: Path, origin: Mapping[str, Any], required: bool) -> None:
    """Refuse what was written from something else; without a note, what is ``required`` to have."""
    if not note.exists():
        if required:
            raise CorpusError(
                f"{place}: expected no such split yet, or one that this command wrote, got one "
                f"without {note.name}: delete it to write it anew"
            )
        return
    was, now = read_sealed(note), dict(origin)
    for name in sorted((was.keys() | now.keys()) - {"sources"}):
        if was.get(name) != now.get(name):
            before, after = was.get(name), now.get(name)
            if name == INPUTS:
                before = f"{was.get('sources')} as they were (stamp {before})"
                after = f"{now.get('sources')} as they are now (stamp {after})"
            raise CorpusError(
                f"{place}: expected {name} {before}, from which it was written, got {after}: give "
                "the same, choose another config or folder, or delete it to write it anew"
            )


def inputs_stamp(
    places: Iterable[str | os.PathLike[str]], without: str | os.PathLike[str] | None = None
) -> str:
    """Return 16 hexadecimal digits that change when any file of the inputs does.

    Files count with their names below the input, sizes and times of change, or hashes, as far as
    the place tells them; not with where the input lies. An address that cannot be listed counts by
    its name alone. ``without`` is a folder that is passed over, where the output lies in an input.
    """
    digest, output = hashlib.sha256(), Path(without).resolve() if without is not None else None
    for place in places:
        digest.update(b"input\n")
        for line in sorted(_files(os.fspath(place), output)):
            digest.update(line.encode() + b"\n")
    return digest.hexdigest()[:16]


def _files(place: str, without: Path | None) -> list[str]:
    if "://" not in place:
        root = Path(place)
        files = [root] if root.is_file() else [p for p in root.rglob("*") if p.is_file()]
        if without is not None and without.is_relative_to(root.resolve()):
            files = [p for p in files if not p.resolve().is_relative_to(without)]
        stats = ((p.relative_to(root).as_posix(), p.stat()) for p in files)
        return [f"{name} {s.st_size} {s.st_mtime_ns}" for name, s in stats]
    from fsspec.core import url_to_fs

    filesystem, path = url_to_fs(place)
    try:
        found: dict[str, dict[str, Any]] = filesystem.find(path, detail=True)
    except (NotImplementedError, OSError):
        return [place]
    return [f"{name.removeprefix(path)} {_state(e)}" for name, e in found.items()] or [place]


def _state(entry: Mapping[str, Any]) -> str:
    for name in (*_IDENTITIES, *_TIMES):
        if entry.get(name) is not None:
            return f"{entry.get('size')} {entry[name]}"
    return str(entry.get("size"))
