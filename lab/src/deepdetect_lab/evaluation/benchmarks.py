"""Run benchmarks by name and collect one report.

To add a benchmark, write a function in a module of `protocols`, and add the names of the module and
the function to `BENCHMARKS`. The function takes a `Run` and `BenchmarkOptions`, and returns the
sections of the report.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from deepdetect._shared.errors import ImageError
from deepdetect._shared.options import look_up
from deepdetect._shared.records import file_digest
from deepdetect.detector.pretrained import resolve_weights

from .options import BenchmarkOptions
from .profiling import peak_memory
from .provenance import provenance
from .report import Report, Section
from .run import Run

BENCHMARKS: dict[str, tuple[str, str]] = {
    "oxford": ("planar", "oxford"),
    "hpatches": ("planar", "hpatches"),
    "middlebury": ("stereo", "middlebury"),
    "pose": ("pose", "pose"),
    "sfm": ("sfm", "sfm"),
    "foreground": ("paper", "foreground"),
    "low-visibility": ("planar", "low_visibility"),
}
"""Each benchmark's module in `protocols`, which is imported when needed, and its function."""


def run_benchmarks(
    names: Sequence[str],
    data: str | Path,
    options: BenchmarkOptions,
    *,
    cache: str | Path | None = None,
    quiet: bool = True,
) -> Report:
    """Run the named benchmarks of `BENCHMARKS` and return one report.

    `data` has a subfolder for each data set, or is the folder of the only data set. If a data set
    is missing, its benchmark is reported as failed; if only one benchmark is named, an ImageError
    is raised instead.
    """
    started = time.monotonic()
    entries = [look_up("benchmark", name, BENCHMARKS) for name in names]
    run = Run(Path(data), None if cache is None else Path(cache), quiet)
    sections: list[Section] = []
    for name, (module, function) in zip(names, entries, strict=True):
        benchmark = getattr(import_module(f".protocols.{module}", __package__), function)
        try:
            found = benchmark(run, options)
            if not found:
                run.skipped.append(f"{name}: it has no protocol {' or '.join(options.protocols)}")
            sections += found
        except ImageError as error:
            if len(names) == 1:
                raise
            run.fail(f"the benchmark {name}: {error}")
    metadata = {
        **provenance(),
        **_weights(names, options),
        "results computed, not read from the cache": str(run.made),
        "minutes": f"{(time.monotonic() - started) / 60:.1f}",
        "peak memory": f"{peak_memory() / 1e9:.2f} GB",
    }
    skipped, failures = (tuple(dict.fromkeys(x)) for x in (run.skipped, run.failures))
    title = f"DeepDetect benchmark: {', '.join(names)}"
    return Report(title, metadata, sections, skipped, failures)


def _weights(names: Sequence[str], options: BenchmarkOptions) -> dict[str, str]:
    files = {}
    if set(names) != {"middlebury"}:
        files["weights (SHA-256)"] = [options.detector.weights]
    if "middlebury" in names:
        files["weights for stereo pairs (SHA-256)"] = [
            resolve_weights(weights) for weights in options.geometry_weights
        ]
    return {
        title: ", ".join(f"{file.name} ({file_digest(file)[:16]})" for file in listed)
        for title, listed in files.items()
    }
