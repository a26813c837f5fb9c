"""Which backends are ready here, and what each of the others lacks and where it comes from."""

import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from mint_hub.labelling.backends import BACKENDS, Backend, make
from mint_hub.labelling.environments import Environment
from mint_hub.labelling.readiness import Lack, check, python_lacks
from mint_hub.labelling.stage import Stage


@dataclass(frozen=True)
class Readiness:
    """One backend's state.

    Attributes:
        stage, backend: which.
        what: what it is.
        default: whether it is used unless another is chosen.
        missing: what it lacks; nothing when it would run now.
        automatic: it is not ready, but gets itself what is missing on first use.

    """

    stage: str
    backend: str
    what: str
    default: bool
    missing: tuple[Lack, ...]
    automatic: bool

    @property
    def ready(self) -> bool:
        """Whether it would run now."""
        return not self.missing

    @property
    def lacks(self) -> str:
        """What is missing, in words; empty when ready."""
        return "; ".join(lack.what for lack in self.missing)

    @property
    def where(self) -> str:
        """Where that comes from; empty when ready."""
        return "; ".join(lack.where for lack in self.missing)

    def __str__(self) -> str:
        state = "ready" if self.ready else "on first use" if self.automatic else "lacks"
        lines = [f"{self.stage + '=' + self.backend:<22} {state:<12} {self.what}"]
        for lack in self.missing:
            lines += [f"{'':<23}needs {lack.what}", f"{'':<23}from  {lack.where}"]
        return "\n".join(lines)


def doctor(
    settings: Mapping[str, Mapping[str, Any]] | None = None,
    backends: Iterable[Backend] = BACKENDS,
) -> list[Readiness]:
    """Look at every backend, in the order of the cascade; nothing is made or downloaded.

    Args:
        settings: of backends that have some, by "stage=name": paths of checkouts and weights.
        backends: which to look at.

    Raises:
        ValueError: settings of a backend that does not exist, or that it does not have.

    """
    settings = settings or {}
    chosen = list(backends)
    names = {f"{backend.stage}={backend.name}" for backend in chosen}
    if unknown := sorted(settings.keys() - names):
        expected = ", ".join(sorted(names))
        raise ValueError(f"settings: expected backends among {expected}, got {unknown[0]!r}")
    return [_examine(b, settings.get(f"{b.stage}={b.name}")) for b in chosen]


def check_ready(stages: Iterable[Stage]) -> None:
    """Look at stages before hours go into the first ones.

    Raises:
        NotReadyError: names all that is missing and does not come by itself.

    """
    found = [_lacks_of(stage) for stage in stages]
    check([lack for lacks, automatic in found if not automatic for lack in lacks])


def _examine(backend: Backend, settings: Mapping[str, Any] | None) -> Readiness:
    try:
        lacks, automatic = _lacks(backend, settings)
    except ImportError as error:
        missing = error.name or str(error)
        lacks, automatic = (Lack(f"the module {missing}", f"pip install {missing}"),), False
    return Readiness(
        stage=backend.stage,
        backend=backend.name,
        what=backend.what,
        default=backend.default,
        missing=lacks,
        automatic=automatic,
    )


def _lacks(backend: Backend, settings: Mapping[str, Any] | None) -> tuple[tuple[Lack, ...], bool]:
    """What is missing, and whether only an environment is that comes by itself."""
    backend.load()
    try:
        stage = make(backend.stage, backend.name, settings)
    except ValueError as error:
        if settings is not None:
            raise
        return (Lack(f"settings: {error}", "give them with the backend"),), False
    return _lacks_of(stage)


def _lacks_of(stage: Any) -> tuple[tuple[Lack, ...], bool]:
    python = str(getattr(stage.settings, "python", None) or "")
    environment = getattr(stage, "environment", None) or getattr(
        sys.modules[type(stage).__module__], "ENVIRONMENT", None
    )
    if not isinstance(environment, Environment):
        environment = None
    if hasattr(stage, "lacks"):
        lacks: tuple[Lack, ...] = tuple(stage.lacks())
    else:
        lacks = python_lacks(python, environment) if environment or python else ()
    by_itself = python_lacks(python, environment) if environment and not python else ()
    return lacks, bool(lacks) and set(lacks) <= set(by_itself)
