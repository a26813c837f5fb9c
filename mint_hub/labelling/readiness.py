"""What a backend needs from outside, and how it says what is missing.

Backends that need a Python of their own, a checkout of another project, weights, or licensed files
have a method ``lacks()``; the doctor asks it, and running without what it names raises
`NotReadyError` with the same words.
"""

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mint_hub.labelling.environments import Environment
from mint_hub.labelling.stage import NotReadyError


@dataclass(frozen=True)
class Lack:
    """One thing that is missing.

    Attributes:
        what: the thing, and the setting that names it.
        where: where it comes from.

    """

    what: str
    where: str

    def __str__(self) -> str:
        return f"{self.what}; {self.where}"


def python_for(python: str, environment: Environment | None = None) -> Path:
    """Return the interpreter to use: the user's, else the backend's own environment.

    Raises:
        NotReadyError: neither is there nor can be made.

    """
    if not python and environment is not None:
        return environment.python()
    check(python_lacks(python, environment))
    return _interpreter(python)


def python_lacks(python: str, environment: Environment | None = None) -> tuple[Lack, ...]:
    """Say what is missing of the interpreter; nothing is made."""
    if not python:
        if environment is None:
            where = "give the interpreter of the environment that project was installed into"
            return (Lack("an interpreter (setting python)", where),)
        missing = environment.ready()
        where = "it comes by itself, or give an interpreter that has them as the setting python"
        return (Lack(missing, where),) if missing else ()
    path = _interpreter(python)
    if not (path.is_file() and os.access(path, os.X_OK)):
        return (Lack(f"an interpreter at {python} (setting python)", "give one that exists"),)
    return ()


def path_lacks(setting: str, path: str, what: str, where: str, *inside: str) -> tuple[Lack, ...]:
    """Say what is missing of a file or folder of the user's.

    Args:
        setting: name of the setting that holds the path.
        path: its value; empty when it was not given.
        what: what is expected there.
        where: where to get it.
        inside: files or folders that have to be in it.

    """
    if not path:
        return (Lack(f"{what} (setting {setting}: its path)", where),)
    if not Path(path).exists():
        return (Lack(f"{what} at {path} (setting {setting}), where nothing is", where),)
    missing = [name for name in inside if not (Path(path) / name).exists()]
    if missing:
        return (
            Lack(f"{what} at {path} (setting {setting}): no {', '.join(missing)} in it", where),
        )
    return ()


def check(lacks: Sequence[Lack]) -> None:
    """Raise `NotReadyError` that names all of ``lacks``, if there are any."""
    if lacks:
        raise NotReadyError("missing: " + "; and ".join(str(lack) for lack in lacks))


def _interpreter(python: str) -> Path:
    return Path(shutil.which(python) or python).expanduser()
