"""Running benchmarks: progress, cache, report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..errors import look_up
from ..progress import progress
from ..provenance import provenance
from .cache import StageCache
from .options import BenchmarkOptions
from .registry import BENCHMARKS
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
    chosen = [look_up("benchmark", name, BENCHMARKS) for name in names]
    store = StageCache(None if cache is None else Path(cache))
    workspace = Workspace(Path(data), store)
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
        "weights": options.detector.weights.name,
        "results made, not found in the cache": str(store.made),
    }
    title = f"DeepDetect benchmark: {', '.join(names)}"
    left_out = tuple(dict.fromkeys(workspace.left_out))
    return Report(title, origin, tuple(sections), left_out)
