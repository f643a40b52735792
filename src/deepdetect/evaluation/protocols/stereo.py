"""Stereo pairs with known disparity: reconstructions by several pipelines.

Figure 8 of the paper, and what it lacks: the true disparity, a peer, and chance baselines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ..._shared.errors import ImageError
from ..._shared.records import Arrays
from ...datasets.middlebury import load_calibrated_pair, load_middlebury
from ...datasets.types import CalibratedStereoPair
from ...geometry.camera import Calibration
from ...geometry.point_cloud import PointCloud
from ...viz.render import draw_clouds
from ..charts import picture
from ..metrics.stereo import (
    DISPARITY_TOLERANCES_PX,
    disparity_accuracy,
    half_occluded_accuracy,
)
from ..options import BenchmarkOptions
from ..profiling import Profile
from ..report import Cell, Column, Figure, Section, Table, where
from ..run import Run
from .paper_numbers import FIGURE_8, with_paper_column
from .stereo_pipelines import ROUNDS, STAGES, Pipeline, StereoPoints, pipelines

VOXEL_EDGES = {"mm": 2.0, "baseline": 0.05}
"""Edge of a voxel by unit."""

TRUTH_OFFSETS = {"dolls": 2}
"""Baselines by which the view of a ground truth lies to the left of the left image.

Shifted by them it has under 0.7 of the photometric error; points are evaluated by both.
"""

AS_IT_IS = ""
SHIFTED = "ground truth shifted to its photographs"

TEXT = (
    "Ours: `deepdetect reconstruct --rectified`: keypoints of the left view at its own size, sub- "
    "pixel matches along the rows, depth; strict, so what lies at a disparity discontinuity is "
    "left out. With --density 1 every pixel is asked for, and what only the left view shows is "
    "filled in from the surface beside it (reported as filled). The paper's pipeline: images "
    "squashed to 480x480 as BGR, SIFT, FLANN (10 trees, 100 checks), a ratio for each scene "
    "(cones, rocks, cloth 0.9, dolls 0.85, moebius 0.77; 0.9 elsewhere), essential matrix by "
    "RANSAC at 0.5 px, all as in the authors' notebooks. SIFT: the same with its own keypoints. "
    "SGBM: block 5, three ways, uniqueness 10, speckle filter; every pixel, both views extended by "
    "what the disparities reach beyond them."
)

NOTE = (
    "1 - bad-t: fraction of the points whose true disparity is known that are at most t px "
    "off; EPE: their mean error; completeness: fraction of the pixels with known truth, hidden "
    "ones too, with a point at most 1 px off; the F-score is the harmonic mean of both. "
    "Half-occluded: pixels whose true counterpart lies outside the right image. "
    "Voxels: cubes that hold a point; the paper calls the matches left by the essential matrix "
    f"voxels. Seconds: median of {ROUNDS} runs for ours and SGBM, one run for the others; from "
    "images in memory. Memory: the growth of the process during the stage; all: the most that "
    "it had grown by since the first stage began, the largest of the runs."
)

SHIFTED_NOTE = (
    "The true disparity in the file belongs to another view than the photographs: shifted by whole "
    "baselines it fits them far better. Here it is shifted, and what is hidden from the left view "
    "left out."
)


def middlebury(run: Run, options: BenchmarkOptions) -> list[Section]:
    """Reconstruct the stereo pairs by all pipelines (Figure 8).

    Raises:
        ImageError: there is no scene.
    """
    folder = run.folder("middlebury")
    scenes = sorted(path.parent for path in folder.glob("*/left.png"))
    if not scenes:
        raise ImageError(
            f"there are no stereo scenes in {folder}: it must hold SCENE/left.png and right.png"
        )
    compared = pipelines(options)
    rows = run.rows(
        "",
        compared,
        {scene.name: scene for scene in scenes},
        lambda pipeline, scene: {"points": reconstruct_points(run, pipeline, scene)},
    )
    tables: list[Table] = []
    figures: list[Figure] = []
    for scene in scenes:
        found = {row["method"]: row["points"] for row in where(rows, item=scene.name)}
        if not found:
            continue
        pair = load_calibrated_pair(scene)
        name = f"the ground truth of {scene.name}"
        truths = run.attempt(name, ground_truths, scene) or {AS_IT_IS: None}
        tables += [
            points_table(pair, compared, found, name, truth) for name, truth in truths.items()
        ]
        figure = run.attempt(f"Figure 8 of {scene.name}", clouds_figure, pair, compared, found)
        figures += [figure] if figure else []
    return [Section("Middlebury stereo, and Figure 8", (TEXT,), tables, figures)]


def reconstruct_points(run: Run, pipeline: Pipeline, scene: Path) -> StereoPoints:
    """Reconstruct a scene, the run of median time, or read it from the cache."""

    def make() -> Arrays:
        pair = load_calibrated_pair(scene)
        runs = [pipeline.run(pair) for _ in range(pipeline.rounds)]
        middle = sorted(runs, key=lambda one: one.seconds)[len(runs) // 2]
        return {
            "pixels": middle.pixels,
            "disparity": middle.disparity,
            "filled": np.array(middle.filled),
            "memory": np.array(max(one.memory for one in runs)),
            **{name: profile.packed() for name, profile in middle.profiles.items()},
        }

    files = [scene / name for name in ("left.png", "right.png", "calib.json")]
    kept = run.cached("stereo", (pipeline.name, pipeline.version, files), make)
    return StereoPoints(
        kept["pixels"],
        kept["disparity"],
        int(kept["filled"]),
        {stage: Profile.unpacked(kept[stage]) for stage in STAGES if stage in kept},
        int(kept["memory"]),
    )


def points_table(
    pair: CalibratedStereoPair,
    compared: Sequence[Pipeline],
    found: Mapping[str, StereoPoints],
    name: str,
    truth: np.ndarray | None,
) -> Table:
    """Tabulate number, accuracy, time and memory of the points of all pipelines."""
    unit = _unit(pair)
    edge = VOXEL_EDGES[unit]
    columns = (
        Column("pipeline"),
        Column("points", ",d"),
        Column("of them filled", ",d"),
        Column(f"voxels of {edge:g} {unit}", ",d"),
        *(Column(f"1 - bad-{tolerance:g}", ".4f") for tolerance in DISPARITY_TOLERANCES_PX),
        Column("EPE, px", ".3f"),
        Column("completeness at 1 px", ".4f"),
        Column("F-score", ".4f"),
        Column("half-occluded, with a point", ",d"),
        Column("of these within 1 px", ".4f"),
        *(Column(f"{stage}, s", ".2f") for stage in STAGES),
        Column("seconds", ".2f"),
        *(Column(f"{stage}, MB", ",.0f") for stage in STAGES),
        Column("all, MB", ",.0f"),
    )

    def line(pipeline: Pipeline) -> tuple[Cell, ...]:
        points = found.get(pipeline.name)
        if points is None:
            return (pipeline.title, *(None,) * (len(columns) - 1))
        accuracy: tuple[Cell, ...] = (None,) * (len(DISPARITY_TOLERANCES_PX) + 5)
        if truth is not None:
            score = disparity_accuracy(points.pixels, points.disparity, truth)
            outside = half_occluded_accuracy(points.pixels, points.disparity, truth)
            accuracy = (*score.accuracy, score.epe_px, score.completeness, score.f_score)
            accuracy += outside
        profiles = [points.profiles.get(stage) for stage in STAGES]
        return (
            pipeline.title,
            len(points.pixels),
            points.filled,
            count_voxels(pair.calibration, points.pixels, points.disparity, edge),
            *accuracy,
            *(None if p is None else p.seconds for p in profiles),
            points.seconds,
            *(None if p is None else p.memory / 1e6 for p in profiles),
            points.memory / 1e6,
        )

    key = f"middlebury_{pair.name}" + ("_shifted" if name == SHIFTED else "")
    paper = {p.title: p.paper[pair.name] for p in compared if pair.name in p.paper}
    title = f"{pair.name}, {name}" if name else pair.name
    note = NOTE
    if truth is None:
        note = f"There is no true disparity: nothing is evaluated. {note}"
    elif name == SHIFTED:
        note = f"{SHIFTED_NOTE} {note}"
    table = Table(key, title, columns, tuple(map(line, compared)), note)
    return with_paper_column(table, "points", paper)


def _unit(pair: CalibratedStereoPair) -> str:
    return "mm" if pair.calibration.baseline_mm else "baseline"


def count_voxels(
    calibration: Calibration, pixels: np.ndarray, disparity: np.ndarray, edge: float
) -> int:
    """Count the cubes of a grid that hold a point.

    Args:
        calibration: makes disparities depths.
        pixels: (N, 2) in the left image.
        disparity: (N,) in pixels.
        edge: of a cube, in mm, or in baselines where that is not known.
    """
    cubes = np.floor(_triangulate(calibration, pixels, disparity)[0] / edge).astype(np.int64)
    return len(np.unique(cubes, axis=0))


def _triangulate(
    calibration: Calibration, pixels: np.ndarray, disparity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points with a depth, and which these are."""
    depth = calibration.depth_mm(disparity)
    kept = np.isfinite(depth)
    return calibration.camera0.rays(pixels[kept]) * depth[kept, None], kept


def clouds_figure(
    pair: CalibratedStereoPair, compared: Sequence[Pipeline], found: Mapping[str, StereoPoints]
) -> Figure | None:
    """Draw Figure 8: the points of the pipelines that the paper draws; None without any."""
    clouds = {}
    unit = _unit(pair)
    # Ours come last, as in the paper.
    for pipeline in sorted(compared, key=lambda pipeline: pipeline.drawn == "ours"):
        points = found.get(pipeline.name)
        if not pipeline.drawn or points is None:
            continue
        space, kept = _triangulate(pair.calibration, points.pixels, points.disparity)
        columns, rows = np.rint(points.pixels[kept]).astype(np.int64).T
        clouds[pipeline.drawn] = PointCloud(space, pair.left[rows, columns], unit)
    if not any(map(len, clouds.values())):
        return None
    counts = ", ".join(f"{name} {len(cloud):,}" for name, cloud in clouds.items())
    printed = ", ".join(f"{t} {n[pair.name]:,}" for t, n in FIGURE_8.items() if pair.name in n)
    paper = f" (in the paper: {printed})" if printed else ""
    title = f"Figure 8, {pair.name}: {counts} points{paper}"
    return Figure(f"figure8_{pair.name}", title, picture(draw_clouds(pair.left, clouds)))


def ground_truths(scene: Path) -> Mapping[str, np.ndarray | None]:
    """Return the true disparities of a scene by name: "" as its file has it, and perhaps shifted.

    Raises:
        ImageError: the scene has no ground truth.
    """
    disparity = load_middlebury(scene).disparity
    offset = TRUTH_OFFSETS.get(scene.name, 0)
    return {AS_IT_IS: disparity} | ({SHIFTED: shift_view(disparity, offset)} if offset else {})


def shift_view(disparity: np.ndarray, baselines: int) -> np.ndarray:
    """Show a disparity map from a view this many baselines to the right; NaN where it is hidden.

    Where several places fall on one pixel the nearest of them is visible.

    Example:
        >>> shift_view(np.array([[np.nan, np.nan, 1.0, 1.0, 2.0]]), 1).tolist()
        [[nan, 1.0, 2.0, nan, nan]]
    """
    rows, columns = np.nonzero(np.isfinite(disparity))
    values = disparity[rows, columns]
    columns = np.rint(columns - baselines * values).astype(np.int64)
    inside = (columns >= 0) & (columns < disparity.shape[1])
    out = np.full(disparity.shape, -np.inf, np.float32)
    np.maximum.at(out, (rows[inside], columns[inside]), values[inside])
    return np.where(np.isfinite(out), out, np.nan).astype(np.float32)
