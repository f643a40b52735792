"""Evaluate the points of stereo pipelines by the true disparity, and draw the paper's Figure 8."""

from __future__ import annotations

import json
import statistics
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from deepdetect._shared.errors import ImageError
from deepdetect.geometry.point_cloud import PointCloud

from ...datasets.middlebury import CalibratedStereoPair, load_calibrated_pair, load_middlebury
from ..clouds import draw_clouds
from ..metrics.stereo import DISPARITY_TOLERANCES_PX, disparity_scores
from ..options import BenchmarkOptions
from ..profiling import profiled
from ..report import Figure, Row, Section, Table, picture, where
from ..run import Run
from .paper_numbers import FIGURE_8, with_paper_column
from .stereo_pipelines import ROUNDS, Pipeline, pipelines

TRUTH_OFFSETS = {"dolls": 2}
"""Scenes whose true disparity map belongs to a viewpoint to the left of the left image, with the
distance in stereo baselines. After the map is shifted to the left image's viewpoint, the
photometric error between the two images is over 30 % lower. Results are evaluated by both maps."""

AS_IT_IS = ""
SHIFTED = "ground truth shifted to its photographs"

TEXT = (
    '"Ours": `deepdetect reconstruct --rectified`, which leaves out points at disparity '
    'discontinuities. "All pixels, --density 1" gives a point for every pixel, and fills in '
    'disparities of pixels that only the left view shows. "The paper\'s pipeline", as in the '
    "authors' notebooks: images are resized to 480x480 with colours in the order BGR, SIFT "
    "descriptors are matched by FLANN (10 trees, 100 checks) with a ratio for each scene (cones, "
    "rocks, cloth 0.9; dolls 0.85; moebius 0.77; others 0.9), and the inliers of an essential "
    "matrix by RANSAC at 0.5 px are kept. SIFT: the paper's pipeline with SIFT keypoints. SGBM: "
    "OpenCV's semi-global matching with block size 5, three-way mode, uniqueness ratio 10, a "
    "speckle filter, and views that are extended beyond their borders."
)

NOTE = (
    "Errors of disparity are measured at points with ground truth. 1 - bad-t: fraction of these "
    "points whose error is at most t px; EPE: their mean error; completeness: fraction of the "
    "pixels with ground truth, occluded ones included, that have a point with an error of at most "
    "1 px; F-score: harmonic mean of 1 - bad-1 and completeness. Half-occluded: number of points "
    "whose true counterpart is outside the right image. Points in the paper: the numbers that it "
    f"gives for voxels, which are inliers of the essential matrix. Seconds: median of {ROUNDS} "
    "runs (ours, SGBM) or time of a single run, with images in memory. MB: growth of the process's "
    "memory, the largest of these runs."
)

SHIFTED_NOTE = (
    "The published disparity map of this scene belongs to another viewpoint than the left "
    "photograph. Here the map is shifted by whole stereo baselines to the viewpoint with which the "
    "photographs agree far better. Points of the map that are hidden in this view are left out."
)


def middlebury(run: Run, options: BenchmarkOptions) -> list[Section]:
    """Run the benchmark: reconstruct each stereo pair by each pipeline, and draw Figure 8."""
    folder = run.folder("middlebury")
    scenes = {path.parent.name: path.parent for path in sorted(folder.glob("*/left.png"))}
    if not scenes:
        raise ImageError(f"{folder} has no folders with left.png and right.png: put scenes there")
    compared = pipelines(options)
    rows = run.rows("", compared, scenes, partial(reconstruct_points, run))
    tables: list[Table] = []
    figures: list[Figure] = []
    for name, scene in scenes.items():
        found = {row["method"]: row for row in where(rows, item=name)}
        if not found:
            continue
        pair = load_calibrated_pair(scene)
        has_truth = "ground_truth" in json.loads((scene / "calib.json").read_bytes())
        work = f"the ground truth of {name}", ground_truths, scene
        truths = run.attempt(*work) if has_truth else None
        for which, truth in (truths or {AS_IT_IS: None}).items():
            tables.append(points_table(pair, compared, found, which, truth))
        figure = run.attempt(f"Figure 8 of {name}", clouds_figure, pair, compared, found)
        figures += [figure] if figure else []
    return [Section("Middlebury stereo, and Figure 8", (TEXT,), tables, figures)]


def reconstruct_points(run: Run, pipeline: Pipeline, scene: Path) -> Row:
    """Reconstruct a scene by a pipeline, or read the result from the cache.

    Returns the "pixels" with a point, (N, 2), their "disparity", (N,), and the table columns that
    do not depend on ground truth.
    """

    def make() -> Row:
        pair = load_calibrated_pair(scene)
        run_once, profiles = pipeline.prepare(pair), []
        for _ in range(pipeline.rounds):
            with profiled() as profile:
                pixels, disparity, filled = run_once()
            profiles.append(profile)
        return {
            "pixels": pixels,
            "disparity": disparity,
            "points": len(pixels),
            "of them filled": filled,
            "seconds": statistics.median(profile.seconds for profile in profiles),
            "all, MB": max(profile.memory for profile in profiles) / 1e6,
        }

    files = [scene / name for name in ("left.png", "right.png", "calib.json")]
    return run.cached("stereo", (pipeline.name, pipeline.version, files), make)


def points_table(
    pair: CalibratedStereoPair,
    compared: Sequence[Pipeline],
    found: Mapping[str, Row],
    which: str,
    truth: np.ndarray | None,
) -> Table:
    """Tabulate points, time and memory of each pipeline, and errors if `truth` is not None."""
    columns = {
        **{"pipeline": "", "points": ",d", "of them filled": ",d"},
        **{f"1 - bad-{tolerance:g}": ".4f" for tolerance in DISPARITY_TOLERANCES_PX},
        **{"EPE, px": ".3f", "completeness at 1 px": ".4f", "F-score": ".4f"},
        **{"half-occluded, with a point": ",d", "of these within 1 px": ".4f"},
        **{"seconds": ".2f", "all, MB": ",.0f"},
    }
    lines: list[Row] = []
    for pipeline in compared:
        line = {"pipeline": pipeline.name, **found.get(pipeline.name, {})}
        if pipeline.name in found:
            points = line["pixels"], line["disparity"]
            line |= {} if truth is None else disparity_scores(*points, truth)
        lines.append(line)
    key = f"middlebury_{pair.name}" + ("_shifted" if which == SHIFTED else "")
    paper = {p.name: p.paper[pair.name] for p in compared if pair.name in p.paper}
    title = f"{pair.name}, {which}" if which else pair.name
    unknown = "" if truth is not None else "This scene has no ground truth. "
    note = f"{SHIFTED_NOTE} {NOTE}" if which == SHIFTED else unknown + NOTE
    return with_paper_column(Table(key, title, columns, lines, note), "points", paper)


def clouds_figure(
    pair: CalibratedStereoPair, compared: Sequence[Pipeline], found: Mapping[str, Row]
) -> Figure | None:
    """Draw Figure 8 with the clouds of the pipelines that the paper draws; None without points."""
    clouds = {}
    # Our pipeline comes last, as in the paper.
    for pipeline in sorted(compared, key=lambda pipeline: pipeline.drawn == "ours"):
        points = found.get(pipeline.name)
        if not pipeline.drawn or points is None:
            continue
        depth = pair.calibration.depth_mm(points["disparity"])
        kept = np.isfinite(depth)
        pixels = points["pixels"][kept]
        space = pair.calibration.camera0.rays(pixels) * depth[kept, None]
        columns, rows = np.rint(pixels).astype(np.int64).T
        unit = "mm" if pair.calibration.baseline_mm else "baseline"
        clouds[pipeline.drawn] = PointCloud(space, pair.left[rows, columns], unit)
    if not any(map(len, clouds.values())):
        return None
    counts = ", ".join(f"{name} {len(cloud):,}" for name, cloud in clouds.items())
    printed = ", ".join(f"{t} {n[pair.name]:,}" for t, n in FIGURE_8.items() if pair.name in n)
    paper = f" (in the paper: {printed})" if printed else ""
    title = f"Figure 8, {pair.name}: {counts} points{paper}"
    return Figure(f"figure8_{pair.name}", title, picture(draw_clouds(pair.left, clouds)))


def ground_truths(scene: Path) -> Mapping[str, np.ndarray | None]:
    """Return the true disparity map of a scene as stored and, for `TRUTH_OFFSETS`, also shifted."""
    disparity = load_middlebury(scene).disparity
    offset = TRUTH_OFFSETS.get(scene.name, 0)
    return {AS_IT_IS: disparity} | ({SHIFTED: shift_view(disparity, offset)} if offset else {})


def shift_view(disparity: np.ndarray, baselines: int) -> np.ndarray:
    """Warp a disparity map to a viewpoint that is `baselines` stereo baselines farther right.

    The nearest of several points on a pixel hides the others; pixels without a point are NaN.
    """
    rows, columns = np.nonzero(np.isfinite(disparity))
    values = disparity[rows, columns]
    columns = np.rint(columns - baselines * values).astype(np.int64)
    inside = (columns >= 0) & (columns < disparity.shape[1])
    out = np.full(disparity.shape, -np.inf, np.float32)
    np.maximum.at(out, (rows[inside], columns[inside]), values[inside])
    return np.where(np.isfinite(out), out, np.nan).astype(np.float32)
