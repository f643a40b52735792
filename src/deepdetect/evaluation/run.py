"""Running benchmarks: progress, cache, report."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from .._shared.errors import ImageError
from .._shared.progress import progress
from .._shared.provenance import provenance
from .._shared.registry import look_up
from ..detector.pretrained import resolve_weights
from .cache import StageCache, file_digest
from .metering import peak_memory
from .options import BenchmarkOptions
from .registry import BENCHMARKS, Benchmark
from .report import Report
from .workspace import Workspace


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
    """
    started = time.monotonic()
    chosen = [look_up("benchmark", name, BENCHMARKS) for name in names]
    store = StageCache(None if cache is None else Path(cache))
    workspace = Workspace(Path(data), store)
    if len(chosen) > 1:
        chosen = [one for one in chosen if _has_data(one, workspace, options)]
    total = sum(benchmark.steps(workspace, options) for benchmark in chosen)
    sections = []
    with progress(total, "benchmark", "step", quiet) as bar:

        def done(steps: int, text: str) -> None:
            bar.set_postfix_str(text, refresh=False)
            bar.update(steps)

        workspace.done = done
        for benchmark in chosen:
            sections += benchmark.sections(workspace, options)
    origin = {
        **provenance(),
        **_weights(chosen, options),
        "results made, not found in the cache": str(store.made),
    }
    origin["minutes"] = f"{(time.monotonic() - started) / 60:.1f}"
    origin["peak memory"] = f"{peak_memory() / 1e9:.2f} GB"
    title = f"DeepDetect benchmark: {', '.join(names)}"
    left_out = tuple(dict.fromkeys(workspace.left_out))
    return Report(title, origin, tuple(sections), left_out)


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


def _has_data(benchmark: Benchmark, workspace: Workspace, options: BenchmarkOptions) -> bool:
    """Tell whether a benchmark's data are there; if not, note that it is left out."""
    try:
        benchmark.steps(workspace, options)
    except ImageError as error:
        workspace.left_out.append(f"the benchmark {benchmark.name}: {error}")
        return False
    return True
