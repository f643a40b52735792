"""Stereo pairs with known disparity: reconstructions by several pipelines.

Figure 8 of the paper, and what it lacks: the true disparity, a peer, and chance baselines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...datasets.middlebury import load_calibrated_pair, load_middlebury
from ...datasets.types import CalibratedStereoPair, StereoPair
from ...geometry.camera import Calibration
from ...geometry.point_cloud import PointCloud
from ...io.image import luma
from ...viz.render import draw_clouds
from ..cache import Arrays, file_digest
from ..charts import picture
from ..context import BenchmarkContext, pack_profile, unpack_profile
from ..metrics.stereo import DISPARITY_TOLERANCES_PX, disparity_accuracy
from ..options import BenchmarkOptions
from ..profiling import Profile
from ..report import Cell, Column, Figure, Table
from ..tasks import Part, Task
from .paper_numbers import FIGURE_8, FIGURE_8_CAUSES, with_paper_column
from .stereo_outside import CROPPED_PX, crop_pair, outside_table
from .stereo_pipelines import ROUNDS, STAGES, Pipeline, StereoPoints, pipelines

VOXEL_EDGES = {"mm": 2.0, "baseline": 0.05}
"""Edge of a voxel by unit."""

MAX_SHIFTED_ERROR = 0.7
"""A ground truth is shifted when the photometric error is then under this fraction of before."""

VIEW_OFFSETS = (-4, -3, -2, -1, 1, 2, 3, 4)
"""Baselines that the ground truth's view may be beside the left photograph's."""

AS_IT_IS = ""
SHIFTED = "ground truth shifted to its photographs"

STEREO_TEXT = (
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


def stereo_parts(
    context: BenchmarkContext, options: BenchmarkOptions, folders: Sequence[Path]
) -> list[Part]:
    """Reconstruct each scene by all pipelines."""
    compared = pipelines(options)
    return [_scene_part(context, compared, folder) for folder in folders]


def _scene_part(context: BenchmarkContext, compared: Sequence[Pipeline], folder: Path) -> Part:
    dense = [pipeline for pipeline in compared if pipeline.every_pixel]
    runs = [(one, 0) for one in compared] + [(one, o) for o in CROPPED_PX for one in dense]
    tasks: dict[tuple[str, int], Task] = {
        (pipeline.title, offset): Task(
            f"{pipeline.title} on {folder.name}" + (f", offset {offset:+d} px" if offset else ""),
            partial(_points, context, pipeline, folder, offset),
        )
        for pipeline, offset in runs
    }

    def summarize(found: Mapping[Any, StereoPoints]) -> Sequence[Table | Figure]:
        if not found:
            return []
        scene = load_calibrated_pair(folder)
        name = f"the ground truth of {folder.name}"
        truths = context.try_run(name, partial(ground_truths, folder))
        named = (truths or {AS_IT_IS: None}).items()
        whole = {title: points for (title, offset), points in found.items() if not offset}
        tables = [_table(scene, compared, whole, name, truth) for name, truth in named]
        if truths:
            # Of the truth that belongs to the photographs.
            *_, truth = truths.values()
            title = f"{tables[-1].title}: pixels whose counterpart lies outside the right image"
            tables.append(
                outside_table(scene.name, title, truth, found, [one.title for one in dense])
            )
        name = f"Figure 8 of {folder.name}"
        figure = context.try_run(name, partial(_figure, scene, compared, whole))
        return [*tables, *([figure] if figure is not None else [])]

    return Part(tasks, summarize)


def _points(
    context: BenchmarkContext, pipeline: Pipeline, folder: Path, offset_px: int
) -> StereoPoints:
    """Reconstruct a scene, cropped to an offset of the disparity, or read it from the cache."""

    def make() -> Arrays:
        scene = crop_pair(load_calibrated_pair(folder), offset_px)
        runs = [pipeline.run(scene) for _ in range(1 if offset_px else pipeline.rounds)]
        middle = sorted(runs, key=lambda run: run.seconds)[len(runs) // 2]
        arrays = {
            "pixels": middle.pixels,
            "disparity": middle.disparity,
            "filled": np.array(middle.filled),
            "memory": np.array(max(run.memory for run in runs)),
        }
        for stage in STAGES:
            arrays |= pack_profile(stage, middle.profiles.get(stage, Profile()))
        return arrays

    key = {
        "pipeline": pipeline.title,
        "version": pipeline.version,
        "offset": offset_px,
        "files": [file_digest(folder / n) for n in ("left.png", "right.png", "calib.json")],
    }
    kept = context.cache.get("stereo", key, make)
    profiles = {stage: unpack_profile(stage, kept) for stage in STAGES}
    return StereoPoints(
        kept["pixels"],
        kept["disparity"],
        int(kept["filled"]),
        {stage: profile for stage, profile in profiles.items() if profile.seconds},
        int(kept["memory"]),
    )


def _table(
    scene: CalibratedStereoPair,
    compared: Sequence[Pipeline],
    found: Mapping[str, StereoPoints],
    name: str,
    truth: np.ndarray | None,
) -> Table:
    unit = _unit(scene)
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
        *(Column(f"{stage}, s", ".2f") for stage in STAGES),
        Column("seconds", ".2f"),
        *(Column(f"{stage}, MB", ",.0f") for stage in STAGES),
        Column("all, MB", ",.0f"),
    )
    rows: list[tuple[Cell, ...]] = []
    for pipeline in compared:
        points = found.get(pipeline.title)
        if points is None:
            rows.append((pipeline.title, *(None,) * (len(columns) - 1)))
            continue
        profiles = [points.profiles.get(stage) for stage in STAGES]
        rows.append(
            (
                pipeline.title,
                len(points.pixels),
                points.filled,
                count_voxels(scene.calibration, points.pixels, points.disparity, edge),
                *_accuracy(points, truth),
                *(None if p is None else p.seconds for p in profiles),
                points.seconds,
                *(None if p is None else p.memory / 1e6 for p in profiles),
                points.memory / 1e6,
            )
        )
    key = f"middlebury_{scene.name}" + ("_shifted" if name == SHIFTED else "")
    paper = {p.title: p.paper[scene.name] for p in compared if scene.name in p.paper}
    title = f"{scene.name}, {name}" if name else scene.name
    table = Table(key, title, columns, tuple(rows), _note(name, truth))
    return with_paper_column(table, "points", paper, FIGURE_8_CAUSES)


def _unit(scene: CalibratedStereoPair) -> str:
    return "mm" if scene.calibration.baseline_mm else "baseline"


def _note(name: str, truth: np.ndarray | None) -> str:
    note = (
        "1 - bad-t: fraction of the points whose true disparity is known that are at most t px "
        "off; EPE: their mean error; completeness: fraction of the pixels with known truth, hidden "
        "ones too, with a point at most 1 px off; the F-score is the harmonic mean of both. "
        "Voxels: cubes that hold a point; the paper calls the matches left by the essential matrix "
        f"voxels. Seconds: median of {ROUNDS} runs for ours and SGBM, one run for the others; from "
        "images in memory. Memory: the growth of the process during the stage; all: the most that "
        "it had grown by since the first stage began, the largest of the runs."
    )
    if truth is None:
        return f"There is no true disparity: nothing is evaluated. {note}"
    if name == SHIFTED:
        note = (
            "The true disparity in the file belongs to another view than the photographs: "
            "shifted by whole baselines it fits them far better. Here it is shifted, and what is "
            f"hidden from the left view left out. {note}"
        )
    return note


def _accuracy(points: StereoPoints, truth: np.ndarray | None) -> tuple[Cell, ...]:
    if truth is None:
        return (None,) * (len(DISPARITY_TOLERANCES_PX) + 3)
    score = disparity_accuracy(points.pixels, points.disparity, truth)
    return (*score.accuracy, score.epe_px, score.completeness, score.f_score)


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


def _figure(
    scene: CalibratedStereoPair, compared: Sequence[Pipeline], found: Mapping[str, StereoPoints]
) -> Figure | None:
    clouds = {}
    unit = _unit(scene)
    # Ours come last, as in the paper.
    for pipeline in sorted(compared, key=lambda pipeline: pipeline.drawn == "ours"):
        points = found.get(pipeline.title)
        if not pipeline.drawn or points is None:
            continue
        space, kept = _triangulate(scene.calibration, points.pixels, points.disparity)
        columns, rows = np.rint(points.pixels[kept]).astype(np.int64).T
        clouds[pipeline.drawn] = PointCloud(space, scene.left[rows, columns], unit)
    if not any(map(len, clouds.values())):
        return None
    counts = ", ".join(f"{name} {len(cloud):,}" for name, cloud in clouds.items())
    printed = ", ".join(f"{t} {n[scene.name]:,}" for t, n in FIGURE_8.items() if scene.name in n)
    paper = f" (in the paper: {printed})" if printed else ""
    title = f"Figure 8, {scene.name}: {counts} points{paper}"
    return Figure(f"figure8_{scene.name}", title, picture(draw_clouds(scene.left, clouds)))


def ground_truths(scene: Path) -> dict[str, np.ndarray]:
    """Return the true disparities of a scene by name: "" as its file has it, and perhaps shifted.

    A disparity map belongs to one view. One of another view of the same row of cameras has a large
    photometric error, and a far smaller one when it is shifted; then points are evaluated by both.

    Raises:
        ImageError: the scene has no ground truth.
    """
    pair = load_middlebury(scene)
    disparity = pair.disparity
    offset = view_offset(pair)
    shifted = {SHIFTED: shift_view(disparity, offset)} if offset else {}
    return {AS_IT_IS: disparity, **shifted}


def view_offset(pair: StereoPair) -> int:
    """Return how many baselines to the left of the left image the ground truth's view is.

    0 unless the photometric error of a shifted ground truth is far smaller (`MAX_SHIFTED_ERROR`).
    """
    disparity = pair.disparity
    errors = {o: photometric_error(pair, shift_view(disparity, o)) for o in VIEW_OFFSETS}
    best = min(errors, key=lambda offset: errors[offset])
    limit = MAX_SHIFTED_ERROR * photometric_error(pair, disparity)
    return best if errors[best] < limit else 0


def photometric_error(pair: StereoPair, disparity: np.ndarray) -> float:
    """Return the mean difference of the luma of what a disparity says are the same places."""
    left, right = (luma(image).astype(np.float32) for image in (pair.left, pair.right))
    rows, columns = np.nonzero(np.isfinite(disparity))
    there = columns - disparity[rows, columns]
    inside = (there >= 0) & (there <= left.shape[1] - 1)
    if not inside.any():
        return float("inf")
    rows, columns, there = rows[inside], columns[inside], there[inside]
    before = np.floor(there).astype(np.int64)
    after = np.minimum(before + 1, left.shape[1] - 1)
    weight = there - before
    seen = (1 - weight) * right[rows, before] + weight * right[rows, after]
    return float(np.abs(left[rows, columns] - seen).mean())


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
