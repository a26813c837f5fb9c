"""One door to every benchmark."""

from mint_hub.evaluation.bench_arctic import ArcticBenchmark
from mint_hub.evaluation.bench_hot3d import Hot3DBenchmark
from mint_hub.evaluation.bench_shards import (
    LabelsBenchmark,
    ShardsBenchmark,
    synthetic_benchmark,
)
from mint_hub.evaluation.clips import NAMES, Benchmark, Source, chosen


def open_benchmark(source: Source, num_procs: int = 1) -> Benchmark:
    """Open a benchmark.

    Args:
        source: which.
        num_procs: processes that draw a synthetic benchmark where it is not kept yet.

    Raises:
        BenchmarkError: a ValueError that names what is missing, and where to get it.
        ImportError, RuntimeError: a synthetic benchmark without its renderer.

    """
    if source.name in ("bench", "bench-ood"):
        return chosen(synthetic_benchmark(source, num_procs))
    kinds = {
        "hot3d": Hot3DBenchmark,
        "arctic": ArcticBenchmark,
        "shards": ShardsBenchmark,
        "labels": LabelsBenchmark,
    }
    if source.name not in kinds:
        raise ValueError(f"benchmark: expected one of {list(NAMES)}, got {source.name!r}")
    return chosen(kinds[source.name](source))
