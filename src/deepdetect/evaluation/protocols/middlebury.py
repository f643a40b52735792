"""Middlebury stereo pairs: points, how many are right, how complete they are, at what cost.

Figure 8 of the paper, and what it lacks: the true disparity, a peer, and controls.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..._shared.errors import ImageError
from ...datasets.middlebury import load_calibrated_pair
from ...datasets.types import CalibratedStereoPair
from ...geometry.camera import Calibration
from ...geometry.point_cloud import PointCloud
from ...viz.render import draw_clouds
from ..cache import file_digest
from ..charts import picture
from ..metering import Meter
from ..metrics.disparity_accuracy import TOLERANCES, disparity_accuracy
from ..options import BenchmarkOptions
from ..report import Cell, Column, Figure, Section, Table
from ..stages import versions
from ..workspace import Workspace
from .stereo_pipelines import (
    PUBLISHED,
    ROUNDS,
    STAGES,
    Pipeline,
    StereoPoints,
    pipelines,
)
from .stereo_truth import AS_IT_IS, MOVED, truths

EDGES = {"mm": 2.0, "baseline": 0.05}
"""Edge of a voxel by unit."""


def middlebury_steps(workspace: Workspace, options: BenchmarkOptions) -> int:
    """Return the number of steps that `middlebury_sections` reports."""
    return len(_scenes(workspace)) * len(pipelines(options))


def middlebury_sections(workspace: Workspace, options: BenchmarkOptions) -> list[Section]:
    """Reconstruct each scene by all pipelines."""
    tables, figures = [], []
    ways = pipelines(options)
    for folder in _scenes(workspace):
        found: dict[str, StereoPoints] = {}
        scene = workspace.attempt(f"the scene {folder.name}", load_calibrated_pair, folder)
        for way in ways:
            if scene is not None:
                what = f"{way.title} on {folder.name}"
                points = workspace.attempt(what, _points, workspace, way, scene, folder)
                if points is not None:
                    found[way.title] = points
            workspace.done(1, f"{folder.name}, {way.title}")
        if scene is None:
            continue
        judged = workspace.attempt(f"the truth of {folder.name}", truths, folder) or {}
        for name in judged or [AS_IT_IS]:
            tables.append(_table(scene, ways, found, name, judged.get(name)))
        figure = workspace.attempt(f"Figure 8 of {folder.name}", _figure, scene, ways, found)
        if figure is not None:
            figures.append(figure)
    text = (
        "Ours: `deepdetect reconstruct --rectified`: keypoints of the left view at its own size, "
        "matches along the rows below the pixel, depth; strict, so what lies at a jump of depth "
        "is left out. With --density 1 every pixel is asked for, and what only the left view "
        "shows is filled in from behind (told as filled). Published pipeline: images squashed to "
        "480x480 as BGR, SIFT, FLANN (10 trees, 100 checks), a ratio for each scene (cones, "
        "rocks, cloth 0.9, dolls 0.85, moebius 0.77; 0.9 elsewhere), essential matrix by RANSAC at "
        "0.5 px, all as in the authors' notebooks. SIFT: the same with its own keypoints. SGBM: "
        "block 5, three ways, uniqueness 10, speckle filter; "
        "every pixel, both views continued to the left.",
    )
    return [Section("Middlebury stereo, and Figure 8", text, tuple(tables), tuple(figures))]


def _scenes(workspace: Workspace) -> list[Path]:
    folder = workspace.folder("middlebury")
    scenes = sorted(path.parent for path in folder.glob("*/left.png"))
    if not scenes:
        raise ImageError(
            f"there are no stereo scenes in {folder}: it must hold SCENE/left.png and right.png"
        )
    return scenes


def _points(
    workspace: Workspace, way: Pipeline, scene: CalibratedStereoPair, folder: Path
) -> StereoPoints:
    """Reconstruct a scene, or read its points from the cache."""

    def make() -> dict[str, np.ndarray]:
        runs = [way.run(scene) for _ in range(way.rounds)]
        middle = sorted(runs, key=lambda run: run.seconds)[len(runs) // 2]
        meters = [middle.meters.get(stage, Meter()) for stage in STAGES]
        return {
            "pixels": middle.pixels,
            "disparity": middle.disparity,
            "filled": np.array(middle.filled),
            "meters": np.array([(meter.seconds, meter.memory) for meter in meters]),
            "memory": np.array(max(run.memory for run in runs)),
            "run": np.array(workspace.run),
        }

    key = {
        "pipeline": way.title,
        "version": way.version,
        "files": [file_digest(folder / n) for n in ("left.png", "right.png", "calib.json")],
        **versions(),
    }
    kept = workspace.cache.get("stereo", key, make)
    meters = {
        stage: Meter(float(seconds), int(memory))
        for stage, (seconds, memory) in zip(STAGES, kept["meters"], strict=True)
        if seconds
    }
    numbers = (int(kept[name]) for name in ("memory", "run"))
    return StereoPoints(kept["pixels"], kept["disparity"], int(kept["filled"]), meters, *numbers)


def _table(
    scene: CalibratedStereoPair,
    ways: list[Pipeline],
    found: dict[str, StereoPoints],
    name: str,
    truth: np.ndarray | None,
) -> Table:
    unit = "mm" if scene.calibration.baseline_mm else "baseline"
    edge = f"{EDGES[unit]:g} {unit}"
    slow = [points for title, points in found.items() if title.startswith(PUBLISHED)]
    columns = (
        Column("pipeline"),
        Column("points", ",d"),
        Column("points in the paper", ",d"),
        Column("of them filled", ",d"),
        Column(f"voxels of {edge}", ",d"),
        *(Column(f"within {tolerance:g} px", ".4f") for tolerance in TOLERANCES),
        Column("mean error, px", ".3f"),
        Column("completeness at 1 px", ".4f"),
        Column("F-score", ".4f"),
        *(Column(f"{stage}, s", ".2f") for stage in STAGES),
        Column("seconds", ".2f"),
        Column("times faster than published", ".1f"),
        *(Column(f"{stage}, MB", ",.0f") for stage in STAGES),
        Column("all, MB", ",.0f"),
    )
    rows: list[tuple[Cell, ...]] = []
    for way in ways:
        points = found.get(way.title)
        if points is None:
            rows.append((way.title, *(None,) * (len(columns) - 1)))
            continue
        faster = None
        if slow and slow[0].run == points.run and not way.title.startswith(PUBLISHED):
            faster = slow[0].seconds / points.seconds
        rows.append(
            (
                way.title,
                len(points.pixels),
                way.paper.get(scene.name),
                points.filled,
                voxels(scene.calibration, points.pixels, points.disparity, EDGES[unit]),
                *_accuracy(points, truth),
                *(_of(points, stage, "seconds", 1) for stage in STAGES),
                points.seconds,
                faster,
                *(_of(points, stage, "memory", 1e6) for stage in STAGES),
                points.memory / 1e6,
            )
        )
    title = f"{scene.name}, {name}" if name else scene.name
    key = f"middlebury_{scene.name}" + ("_moved" if name == MOVED else "")
    return Table(key, title, columns, tuple(rows), _note(name, truth))


def _note(name: str, truth: np.ndarray | None) -> str:
    note = (
        "Shares are of the points whose true disparity is known; completeness is the share of the "
        "pixels with known truth, hidden ones too, with a point at most 1 px off; the F-score is "
        "the harmonic mean of both. Voxels: cubes that hold a point. Seconds: median of "
        f"{ROUNDS} runs for ours and SGBM, one run for the others; from images in memory. Memory: "
        "the growth of the process during the stage; all: the most that it had grown by since the "
        "first stage began, the largest of the runs. Faster: than the published pipeline with the "
        "first weights; empty where the two were not measured in one run."
    )
    if truth is None:
        return f"There is no true disparity: nothing is judged. {note}"
    if name == MOVED:
        note = (
            "The true disparity in the file was seen from another view than the photographs: "
            "moved by whole baselines it fits them far better. Here it is moved, and what is "
            f"hidden from the left view left out. {note}"
        )
    return note


def _accuracy(points: StereoPoints, truth: np.ndarray | None) -> tuple[Cell, ...]:
    if truth is None:
        return (None,) * (len(TOLERANCES) + 3)
    score = disparity_accuracy(points.pixels, points.disparity, truth)
    return (*score.within, score.mean_error, score.completeness, score.f_score)


def _of(points: StereoPoints, stage: str, what: str, unit: float) -> float | None:
    meter = points.meters.get(stage)
    return None if meter is None else getattr(meter, what) / unit


def voxels(calibration: Calibration, pixels: np.ndarray, disparity: np.ndarray, edge: float) -> int:
    """Count the cubes of a grid that hold a point.

    Args:
        calibration: makes disparities depths.
        pixels: (N, 2) in the left image.
        disparity: (N,) in pixels.
        edge: of a cube, in mm, or in baselines where that is not known.
    """
    cubes = np.floor(_space(calibration, pixels, disparity)[0] / edge).astype(np.int64)
    return len(np.unique(cubes, axis=0))


def _space(
    calibration: Calibration, pixels: np.ndarray, disparity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points with a depth, and which these are."""
    depth = calibration.depth_mm(disparity)
    kept = np.isfinite(depth)
    return calibration.camera0.rays(pixels[kept]) * depth[kept, None], kept


def _figure(
    scene: CalibratedStereoPair, ways: list[Pipeline], found: dict[str, StereoPoints]
) -> Figure | None:
    clouds = {}
    unit = "mm" if scene.calibration.baseline_mm else "baseline"
    # Ours come last, as in the paper.
    for way in sorted(ways, key=lambda way: way.drawn == "ours"):
        points = found.get(way.title)
        if not way.drawn or points is None:
            continue
        space, kept = _space(scene.calibration, points.pixels, points.disparity)
        columns, rows = np.rint(points.pixels[kept]).astype(np.int64).T
        clouds[way.drawn] = PointCloud(space, scene.left[rows, columns], unit)
    if not any(map(len, clouds.values())):
        return None
    counts = ", ".join(f"{name} {len(cloud):,}" for name, cloud in clouds.items())
    png = picture(draw_clouds(scene.left, clouds))
    return Figure(f"figure8_{scene.name}", f"Figure 8, {scene.name}: {counts} points", png)
