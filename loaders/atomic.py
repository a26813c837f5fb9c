"""Files that appear whole or not at all."""

import glob
import os
import shutil
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Generator[Path]:
    """Yield a temporary path beside ``path``; it becomes ``path`` when the block succeeds.

    The temporary name has the same suffix. When the block raises, ``path`` is as it was and the
    temporary file is gone. Missing parent folders are made.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        temporary = Path(folder) / path.name
        yield temporary
        os.replace(temporary, path)


def clear_left_over(path: str | os.PathLike[str]) -> None:
    """Remove what a process that was killed within ``replacing(path)`` left beside ``path``."""
    path = Path(path)
    for folder in path.parent.glob(f".{glob.escape(path.name)}.*/"):
        shutil.rmtree(folder)
