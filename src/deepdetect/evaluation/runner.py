"""Running benchmarks: progress, cache, report."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from .._shared.errors import ImageError, MissingExtraError
from .._shared.progress import progress
from .._shared.provenance import provenance
from .._shared.registry import look_up
from ..detector.pretrained import resolve_weights
from .benchmarks import BENCHMARKS, Benchmark
from .cache import StageCache, file_digest
from .context import BenchmarkContext
from .options import BenchmarkOptions
from .profiling import StageProfiler, peak_memory
from .report import Report
from .tasks import SectionPlan


def run_benchmarks(
    names: Sequence[str],
    data: str | Path,
    options: BenchmarkOptions,
    *,
    cache: str | Path | None = None,
    quiet: bool = True,
) -> Report:
    """Run benchmarks and collect their report.

    Args:
        names: of `BENCHMARKS`.
        data: folder of the data sets, in which each has a folder of its own; or of the only one.
        options: what is compared, and how.
        cache: folder for the results of the stages; None keeps nothing.
        quiet: show no progress bar.

    Raises:
        OptionError: a name is unknown.
        ImageError: data are missing.
        MissingExtraError: a package of the extra "benchmark" is missing.
    """
    started = time.monotonic()
    chosen = [look_up("benchmark", name, BENCHMARKS) for name in names]
    StageProfiler()  # says at once when its package is missing
    store = StageCache(None if cache is None else Path(cache))
    context = BenchmarkContext(Path(data), store)
    plans: list[SectionPlan] = []
    for benchmark in chosen:
        try:
            plans += benchmark.plan(context, options)
        except (ImageError, MissingExtraError) as error:
            if len(chosen) == 1:
                raise
            context.fail(f"the benchmark {benchmark.name}: {error}")
    with progress(sum(map(len, plans)), "benchmark", "task", quiet) as bar:
        sections = tuple(plan.run(context, bar) for plan in plans)
    metadata = {
        **provenance(),
        **_weights(chosen, options),
        "results made, not found in the cache": str(store.made),
        "minutes": f"{(time.monotonic() - started) / 60:.1f}",
        "peak memory": f"{peak_memory() / 1e9:.2f} GB",
    }
    title = f"DeepDetect benchmark: {', '.join(names)}"
    skipped, failures = (tuple(dict.fromkeys(x)) for x in (context.skipped, context.failures))
    return Report(title, metadata, sections, skipped, failures)


def _weights(chosen: Sequence[Benchmark], options: BenchmarkOptions) -> dict[str, str]:
    """Return the names of the weights that were run, with the beginning of their SHA-256."""
    files = {"default": [options.detector.weights]}
    files["dense"] = [resolve_weights(weights) for weights in options.geometry_weights]
    titles = {"default": "weights (SHA-256)", "dense": "weights for stereo pairs (SHA-256)"}
    return {
        title: ", ".join(f"{file.name} ({file_digest(file)[:16]})" for file in files[kind])
        for kind, title in titles.items()
        if any(kind in benchmark.weights for benchmark in chosen)
    }
