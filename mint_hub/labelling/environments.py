"""Environments of their own for backends whose packages cannot share one.

An environment is a virtual environment below ``$MINT_HUB_ENVIRONMENTS`` or
``~/.cache/mint-hub/environments``, made on first use. A mark is written into it last, so that one
whose making was killed is made again; a lock keeps two makers apart.
"""

import fcntl
import hashlib
import importlib.util
import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Final

from packaging.requirements import InvalidRequirement, Requirement

from mint_hub.labelling.stage import NotReadyError
from mint_hub.labelling.worker import clean_environment
from mint_hub.loaders.atomic import replacing

FOLDER_VARIABLE: Final = "MINT_HUB_ENVIRONMENTS"
_MARK: Final = "made.json"
_SHOW_LINES: Final = 6


@dataclass(frozen=True)
class Environment:
    """Packages a backend needs, and the Python that has them.

    Attributes:
        name: [a-z0-9_-]+, part of the folder's name.
        requirements: as pip takes them, pinned where the backend was tried.
        imports: modules that must import once the requirements are there.

    Raises:
        ValueError: a name or requirement that is none.

    """

    name: str
    requirements: tuple[str, ...]
    imports: tuple[str, ...]

    def __post_init__(self) -> None:
        if not self.name or not set(self.name) <= set("abcdefghijklmnopqrstuvwxyz0123456789_-"):
            raise ValueError(f"name: expected only a-z, 0-9, '_' and '-', got {self.name!r}")
        for text in self.requirements:
            try:
                Requirement(text)
            except InvalidRequirement as error:
                raise ValueError(f"requirements: expected what pip takes, got {text!r}") from error

    def python(self) -> Path:
        """Return an interpreter that has the packages; makes the environment where needed.

        That is this interpreter when it satisfies the requirements by itself.

        Raises:
            NotReadyError: it could not be made; the message ends in the reason pip gave.

        """
        if self._here():
            return Path(sys.executable)
        if not self._made():
            with _only_one(self._folder().with_suffix(".lock")):
                if not self._made():
                    self._make()
        return self._interpreter()

    def ready(self) -> str | None:
        """Return None when an interpreter is there, else what is missing and how it comes."""
        if self._here() or self._made():
            return None
        packages = ", ".join(self.requirements)
        return f"an environment with {packages} (made in {self._folder()} on first use, by pip)"

    def where(self) -> str:
        """Tell which interpreter would be used, without making anything."""
        return sys.executable if self._here() else str(self._interpreter())

    def _here(self) -> bool:
        satisfied = all(_satisfied(text) for text in self.requirements)
        names = {name.partition(".")[0] for name in self.imports}
        return satisfied and all(importlib.util.find_spec(name) for name in names)

    def _folder(self) -> Path:
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        identity = json.dumps([self.requirements, self.imports, version, platform.machine()])
        digest = hashlib.sha256(identity.encode()).hexdigest()[:12]
        return environments_folder() / f"{self.name}-{digest}"

    def _interpreter(self) -> Path:
        return self._folder() / "bin" / "python"

    def _made(self) -> bool:
        return (self._folder() / _MARK).is_file() and self._interpreter().exists()

    def _make(self) -> None:
        """Make it from nothing; whatever an earlier attempt left goes first."""
        folder = self._folder()
        packages = " ".join(self.requirements)
        sys.stderr.write(f"mint-hub: making an environment for {self.name}: {packages}\n")
        try:
            if folder.exists():
                shutil.rmtree(folder)
            self._step("venv", [sys.executable, "-m", "venv", str(folder)])
            pip = [str(self._interpreter()), "-m", "pip", "install", "--no-input"]
            self._step("pip", [*pip, "--disable-pip-version-check", *self.requirements])
            names = ", ".join(self.imports)
            if names:
                self._step("import", [str(self._interpreter()), "-c", f"import {names}"])
            with replacing(folder / _MARK) as mark:
                mark.write_text(json.dumps({"requirements": self.requirements}))
        except OSError as error:
            raise NotReadyError(
                f"environment {self.name}: {folder} could not be made: {error}; set "
                f"${FOLDER_VARIABLE} to a folder with room"
            ) from error
        sys.stderr.write(f"mint-hub: environment for {self.name} is ready in {folder}\n")

    def _step(self, what: str, command: list[str]) -> None:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=clean_environment(),
            text=True,
            errors="replace",
            check=False,
        )
        if done.returncode:
            lines = [line for line in done.stdout.splitlines() if line.strip()]
            last = "\n".join(lines[-_SHOW_LINES:]) or f"status {done.returncode}"
            raise NotReadyError(
                f"environment {self.name}: {what} failed in {self._folder()} (it is tried again "
                f"on the next use; or give an interpreter that has {', '.join(self.requirements)} "
                f"as the backend's setting python):\n{last}"
            )


def environments_folder() -> Path:
    """Return the folder that holds them all."""
    given = os.environ.get(FOLDER_VARIABLE)
    return Path(given) if given else Path.home() / ".cache" / "mint-hub" / "environments"


@contextmanager
def _only_one(path: Path) -> Generator[None]:
    """Hold a lock that is let go of when this process ends, however it ends."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = path.open("a")
    except OSError as error:
        raise NotReadyError(
            f"{path.parent}: no environment can be made there: {error}; set ${FOLDER_VARIABLE}"
        ) from error
    with lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@cache
def _satisfied(text: str) -> bool:
    requirement = Requirement(text)
    if requirement.marker is not None and not requirement.marker.evaluate():
        return True
    if requirement.url is not None:
        return False
    try:
        version = metadata.version(requirement.name)
    except metadata.PackageNotFoundError:
        return False
    return requirement.specifier.contains(version, prereleases=True)
