"""The benchmarks: data sets with the protocols that are run on them.

To add a benchmark, write the function that plans its sections, and add its line to `BENCHMARKS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from .._shared.errors import ImageError
from ..datasets.foreground import load_foreground
from ..datasets.oxford import load_oxford
from ..datasets.posed_images import load_posed_scenes
from .context import BenchmarkContext
from .options import BenchmarkOptions
from .planar_benchmarks import (
    Plans,
    plan_hpatches,
    plan_low_visibility,
    plan_oxford,
    select_pairs,
)
from .protocols.foreground import foreground_part
from .protocols.pose import pose_section
from .protocols.sfm import sfm_section
from .protocols.speed import PAIR, speed_part
from .protocols.stereo import STEREO_TEXT, stereo_parts
from .tasks import SectionPlan


@dataclass(frozen=True)
class Benchmark:
    """A benchmark.

    Attributes:
        name: by which users choose it.
        plan: plans the sections of its report; raises ImageError where its data are missing.
        weights: which it runs: "default", "dense" or both.
    """

    name: str
    plan: Callable[[BenchmarkContext, BenchmarkOptions], Plans]
    weights: tuple[str, ...] = ("default",)


def plan_middlebury(context: BenchmarkContext, options: BenchmarkOptions) -> Plans:
    """Reconstruct the stereo pairs by all pipelines (Figure 8)."""
    folder = context.folder("middlebury")
    scenes = sorted(path.parent for path in folder.glob("*/left.png"))
    if not scenes:
        raise ImageError(
            f"there are no stereo scenes in {folder}: it must hold SCENE/left.png and right.png"
        )
    parts = stereo_parts(context, options, scenes)
    return [SectionPlan("Middlebury stereo, and Figure 8", (STEREO_TEXT,), parts)]


def plan_pose(context: BenchmarkContext, options: BenchmarkOptions) -> Plans:
    """Relative poses from matches, in any images with known cameras."""
    scenes = load_posed_scenes(context.folder("pose"), options.pair_selection)
    return [pose_section(context, options, scenes)]


def plan_sfm(context: BenchmarkContext, options: BenchmarkOptions) -> Plans:
    """Cameras and points of many photographs with known cameras."""
    folder = context.folder("sfm")
    if folder == context.data:
        folder = context.folder("pose")
    return [sfm_section(context, options, load_posed_scenes(folder))]


def plan_foreground(context: BenchmarkContext, options: BenchmarkOptions) -> Plans:
    """Table I's second half."""
    photographs = load_foreground(context.folder("foreground"))
    part = foreground_part(context, options.density_features(), photographs)
    return [SectionPlan("Foreground (Table I)", (), [part])]


def plan_speed(context: BenchmarkContext, options: BenchmarkOptions) -> Plans:
    """Time the stages on one pair of Oxford."""
    folder = context.folder("oxford")
    pairs = select_pairs(load_oxford(folder), [PAIR])
    if not pairs:
        raise ImageError(f"speed is measured on {PAIR[0]} of Oxford, which is not in {folder}")
    (pair,) = pairs
    return [SectionPlan("Speed", (), [speed_part(options.matching_features(), pair)])]


BENCHMARKS: dict[str, Benchmark] = {
    benchmark.name: benchmark
    for benchmark in (
        Benchmark("oxford", plan_oxford),
        Benchmark("hpatches", plan_hpatches),
        Benchmark("middlebury", plan_middlebury, ("dense",)),
        Benchmark("pose", plan_pose),
        Benchmark("sfm", plan_sfm),
        Benchmark("foreground", plan_foreground),
        Benchmark("low-visibility", plan_low_visibility),
        Benchmark("speed", plan_speed),
    )
}
