"""Keep a benchmark's numbers: dated JSON, with the machine that gave them.

A benchmark is a script of this folder: ``python benchmarks/smoothing.py`` finds this module beside
itself and writes ``benchmarks/results/smoothing-<date>.json``.
"""

import json
import os
import platform
import tempfile
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

from mint_hub._version import __version__

RESULTS = Path(__file__).parent / "results"


def machine_facts() -> dict[str, Any]:
    """Processor, cores this process may use, memory, load, and the versions that matter."""
    return {
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "memory_gib": _memory_gib(),
        "load_average_1m": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{name: _version(name) for name in ("numpy", "torch", "transformers")},
        "mint-hub": __version__,
        "threads": {
            name: os.environ[name]
            for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
            if name in os.environ
        },
    }


def write_report(
    name: str,
    results: Mapping[str, Any],
    settings: Mapping[str, Any] | None = None,
    machine: Mapping[str, Any] | None = None,
    folder: Path = RESULTS,
) -> Path:
    """Write ``folder/<name>-<date>.json`` whole or not at all; a second run that day replaces it.

    Args:
        name: the benchmark's.
        results: what was measured; units belong in the keys ("ms_a_frame").
        settings: what was run: sizes, seeds, repetitions.
        machine: facts beyond ``machine_facts()``, such as the accelerator.
        folder: where to.

    Returns:
        The file's path.

    """
    now = datetime.now(UTC)
    report = {
        "benchmark": name,
        "date": now.isoformat(timespec="seconds"),
        "machine": {**machine_facts(), **(machine or {})},
        "settings": dict(settings or {}),
        "results": dict(results),
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}-{now:%Y-%m-%d}.json"
    text = json.dumps(report, indent=2, allow_nan=False) + "\n"
    with tempfile.NamedTemporaryFile("w", dir=folder, suffix=".part", delete=False) as part:
        part.write(text)
    os.chmod(part.name, 0o644)
    os.replace(part.name, path)
    return path


def seconds(work: Callable[[], Any], repeats: int = 5) -> float:
    """Median wall-clock seconds of ``work()`` after one call to warm up."""
    work()
    taken = []
    for _ in range(repeats):
        start = perf_counter()
        work()
        taken.append(perf_counter() - start)
    return median(taken)


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or "unknown"


def _memory_gib() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (AttributeError, OSError, ValueError):
        return None


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
