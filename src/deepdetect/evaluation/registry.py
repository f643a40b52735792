"""The benchmarks: one line each.

To add a benchmark, write its module beside this one with two functions of the workspace and the
options, one that tells how many steps there are and one that returns the sections of the report,
and add its line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ..datasets.foreground import load_foreground
from .options import BenchmarkOptions
from .protocols.foreground import foreground_table
from .protocols.hpatches import hpatches_sections, hpatches_steps
from .protocols.low_visibility import low_visibility_sections, low_visibility_steps
from .protocols.middlebury import middlebury_sections, middlebury_steps
from .protocols.oxford import oxford_sections, oxford_steps
from .protocols.speed import speed_sections, speed_steps
from .report import Section
from .workspace import Workspace


@dataclass(frozen=True)
class Benchmark:
    """A benchmark.

    Attributes:
        name: by which users choose it.
        steps: the number of steps that `sections` reports to the workspace.
        sections: measures, and returns the sections of the report.
        weights: which it runs, "default" or "dense" or both.
    """

    name: str
    steps: Callable[[Workspace, BenchmarkOptions], int]
    sections: Callable[[Workspace, BenchmarkOptions], list[Section]]
    weights: tuple[str, ...] = ("default",)


def _foreground_steps(workspace: Workspace, options: BenchmarkOptions) -> int:
    photographs = load_foreground(workspace.folder("foreground"))
    return len(options.density_methods()) * len(photographs)


def _foreground_sections(workspace: Workspace, options: BenchmarkOptions) -> list[Section]:
    photographs = load_foreground(workspace.folder("foreground"))
    table = foreground_table(workspace, options.density_methods(), photographs)
    return [Section("Foreground (Table I)", (), (table,))]


BENCHMARKS: dict[str, Benchmark] = {
    benchmark.name: benchmark
    for benchmark in (
        Benchmark("oxford", oxford_steps, oxford_sections),
        Benchmark("hpatches", hpatches_steps, hpatches_sections),
        Benchmark("middlebury", middlebury_steps, middlebury_sections, ("dense",)),
        Benchmark("foreground", _foreground_steps, _foreground_sections),
        Benchmark("low-visibility", low_visibility_steps, low_visibility_sections),
        Benchmark("speed", speed_steps, speed_sections, ("default", "dense")),
    )
}
