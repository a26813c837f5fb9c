"""Models and labels against truth: benchmarks, scores with their uncertainty, tables, one report.

    benchmark = open_benchmark(Source("shards", "corpus"))
    results = evaluate(benchmark.source, Predictor.of("labels/"))
    write_report(results, "out")

Every table carries answers that need no model (``trivial``): a number is only good beside them.
Metrics themselves are in `mint_hub.geometry.metrics`.
"""
