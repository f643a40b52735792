"""Stereo pairs with known disparity reconstructed by several pipelines: Figure 8 of the paper.

Beside it the true disparity, a peer, and chance baselines.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from ..._shared.errors import ImageError
from ..._shared.opencv import cv2
from ..._shared.progress import progress
from ..._shared.records import file_digest
from ...datasets.middlebury import (
    CalibratedStereoPair,
    StereoPair,
    load_calibrated_pair,
    load_middlebury,
)
from ...detector.detector import AnyDetector, DeepDetect
from ...detector.heatmap import HeatmapOptions
from ...features.matchers import flann_neighbours, match_descriptors
from ...features.matches import Matches
from ...features.selection import SelectionOptions
from ...geometry.camera import Calibration
from ...geometry.point_cloud import PointCloud
from ...matching.pipeline import check_memory, match_images
from ...matching.stereo.matching import find_disparity_range
from ...reconstruction.pipeline import reconstruct
from ...viz.render import draw_clouds
from ..baselines.method import LocalFeature, deepdetect_feature
from ..baselines.opencv import self_described
from ..baselines.random import AllPixels, RandomDetector
from ..metrics.stereo import DISPARITY_TOLERANCES_PX, disparity_scores, stereo_score
from ..options import PAPER_RESOLUTION_PX, BenchmarkOptions
from ..profiling import StageProfiler
from ..report import Figure, Row, Section, Table, picture, where
from ..run import Run
from .paper_numbers import FIGURE_8, with_paper_column

STAGES = ("keypoints", "matching", "geometry")
ROUNDS = 3
"""Runs of what takes seconds; the one of median time is reported."""

TRUTH_OFFSETS = {"dolls": 2}
"""Baselines by which the view of a ground truth lies to the left of the left image.

Shifted by them it has under 0.7 of the photometric error; points are evaluated by both.
"""

AS_IT_IS = ""
SHIFTED = "ground truth shifted to its photographs"

TEXT = (
    "Ours: `deepdetect reconstruct --rectified`: strict, so what lies at a disparity discontinuity "
    "is left out; --density 1 asks for every pixel and fills what only the left view shows. The "
    "paper's pipeline, as in the authors' notebooks: images squashed to 480x480 as BGR, SIFT, "
    "FLANN (10 trees, 100 checks), a ratio for each scene (cones, rocks, cloth 0.9, dolls 0.85, "
    "moebius 0.77; others 0.9), essential matrix by RANSAC at 0.5 px. SIFT: the same with its own "
    "keypoints. SGBM: block 5, three ways, uniqueness 10, speckle filter, both views extended."
)

NOTE = (
    "1 - bad-t: fraction of the points with known truth at most t px off; EPE: their mean error; "
    "completeness: fraction of the pixels with known truth, hidden ones too, with a point at most "
    "1 px off; F-score: harmonic mean of both. Half-occluded: the true counterpart lies outside "
    "the right image. Voxels: cubes that hold a point; the paper means the matches left by the "
    f"essential matrix. Seconds: median of {ROUNDS} runs (ours, SGBM) or one, from images in "
    "memory. Memory: growth of the process in the stage; all: since the first began, largest run."
)

SHIFTED_NOTE = (
    "The true disparity belongs to another view than the photographs; here it is shifted by whole "
    "baselines, which fits them far better, without what the left view does not see."
)


Points = tuple[np.ndarray, np.ndarray, int, StageProfiler]
"""(N, 2) float32 pixels of the left image, (N,) float32 disparities, how many of them were not
matched but filled in, and what the stages took."""


@dataclass(frozen=True, eq=False)
class Pipeline:
    """What turns two images into points; `name` is also the title in tables.

    Results depend on `version` besides the name. `drawn` is the title in Figure 8 (empty: not
    drawn), `paper` the number of points in the paper by scene.
    """

    name: str
    run: Callable[[CalibratedStereoPair], Points]
    version: str = ""
    rounds: int = ROUNDS
    drawn: str = ""
    paper: Mapping[str, float] = field(default_factory=dict)

    @property
    def title(self) -> str:
        return self.name


def middlebury(run: Run, options: BenchmarkOptions) -> list[Section]:
    """Reconstruct the stereo pairs by all pipelines (Figure 8)."""
    folder = run.folder("middlebury")
    scenes = {path.parent.name: path.parent for path in sorted(folder.glob("*/left.png"))}
    if not scenes:
        raise ImageError(
            f"there are no stereo scenes in {folder}: it must hold SCENE/left.png and right.png"
        )
    compared = pipelines(options)

    rows = run.rows("", compared, scenes, partial(reconstruct_points, run))
    tables: list[Table] = []
    figures: list[Figure] = []
    for name, scene in scenes.items():
        found = {row["method"]: row for row in where(rows, item=name)}
        if not found:
            continue
        pair = load_calibrated_pair(scene)
        truths = run.attempt(f"the ground truth of {name}", ground_truths, scene)
        for which, truth in (truths or {AS_IT_IS: None}).items():
            tables.append(points_table(pair, compared, found, which, truth))
        figure = run.attempt(f"Figure 8 of {name}", clouds_figure, pair, compared, found)
        figures += [figure] if figure else []
    return [Section("Middlebury stereo, and Figure 8", (TEXT,), tables, figures)]


def reconstruct_points(run: Run, pipeline: Pipeline, scene: Path) -> Row:
    """Reconstruct a scene, the run of median time, or read it from the cache.

    Returns the "pixels", their "disparity", and the columns that do not depend on the truth.
    """

    def make() -> Row:
        pair = load_calibrated_pair(scene)
        runs = [pipeline.run(pair) for _ in range(pipeline.rounds)]
        runs = sorted(runs, key=lambda points: points[3].total.seconds)
        pixels, disparity, filled, profiler = runs[len(runs) // 2]
        stages = profiler.stages.items()
        return {
            "pixels": pixels,
            "disparity": disparity,
            "points": len(pixels),
            "of them filled": filled,
            **{f"{stage}, s": profile.seconds for stage, profile in stages},
            "seconds": profiler.total.seconds,
            **{f"{stage}, MB": profile.memory / 1e6 for stage, profile in stages},
            "all, MB": max(profiler.total.memory for *_, profiler in runs) / 1e6,
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
    """Tabulate number, accuracy, time and memory of the points of all pipelines."""
    unit, edge = _voxel(pair)
    voxels = f"voxels of {edge:g} {unit}"
    columns = {
        **{"pipeline": "", "points": ",d", "of them filled": ",d", voxels: ",d"},
        **{f"1 - bad-{tolerance:g}": ".4f" for tolerance in DISPARITY_TOLERANCES_PX},
        **{"EPE, px": ".3f", "completeness at 1 px": ".4f", "F-score": ".4f"},
        **{"half-occluded, with a point": ",d", "of these within 1 px": ".4f"},
        **{f"{stage}, s": ".2f" for stage in STAGES},
        "seconds": ".2f",
        **{f"{stage}, MB": ",.0f" for stage in STAGES},
        "all, MB": ",.0f",
    }
    lines: list[Row] = []
    for pipeline in compared:
        line = {"pipeline": pipeline.name, **found.get(pipeline.name, {})}
        if pipeline.name in found:
            points = line["pixels"], line["disparity"]
            line[voxels] = count_voxels(pair.calibration, *points, edge)
            line |= {} if truth is None else disparity_scores(*points, truth)
        lines.append(line)
    key = f"middlebury_{pair.name}" + ("_shifted" if which == SHIFTED else "")
    paper = {p.name: p.paper[pair.name] for p in compared if pair.name in p.paper}
    title = f"{pair.name}, {which}" if which else pair.name
    unknown = "" if truth is not None else "There is no true disparity: nothing is evaluated. "
    note = f"{SHIFTED_NOTE} {NOTE}" if which == SHIFTED else unknown + NOTE
    return with_paper_column(Table(key, title, columns, lines, note), "points", paper)


def _voxel(pair: CalibratedStereoPair) -> tuple[str, float]:
    """Return the unit of a scene, and the edge of its voxels."""
    return ("mm", 2.0) if pair.calibration.baseline_mm else ("baseline", 0.05)


def count_voxels(
    calibration: Calibration, pixels: np.ndarray, disparity: np.ndarray, edge: float
) -> int:
    """Count the cubes of a grid, with edges in mm or baselines, that hold a point."""
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
    pair: CalibratedStereoPair, compared: Sequence[Pipeline], found: Mapping[str, Row]
) -> Figure | None:
    """Draw Figure 8: the points of the pipelines that the paper draws; None without any."""
    clouds = {}
    # Ours come last, as in the paper.
    for pipeline in sorted(compared, key=lambda pipeline: pipeline.drawn == "ours"):
        points = found.get(pipeline.name)
        if not pipeline.drawn or points is None:
            continue
        space, kept = _triangulate(pair.calibration, points["pixels"], points["disparity"])
        columns, rows = np.rint(points["pixels"][kept]).astype(np.int64).T
        clouds[pipeline.drawn] = PointCloud(space, pair.left[rows, columns], _voxel(pair)[0])
    if not any(map(len, clouds.values())):
        return None
    counts = ", ".join(f"{name} {len(cloud):,}" for name, cloud in clouds.items())
    printed = ", ".join(f"{t} {n[pair.name]:,}" for t, n in FIGURE_8.items() if pair.name in n)
    paper = f" (in the paper: {printed})" if printed else ""
    title = f"Figure 8, {pair.name}: {counts} points{paper}"
    return Figure(f"figure8_{pair.name}", title, picture(draw_clouds(pair.left, clouds)))


def ground_truths(scene: Path) -> Mapping[str, np.ndarray | None]:
    """Return the true disparities of a scene: as its file has it, and perhaps shifted."""
    disparity = load_middlebury(scene).disparity
    offset = TRUTH_OFFSETS.get(scene.name, 0)
    return {AS_IT_IS: disparity} | ({SHIFTED: shift_view(disparity, offset)} if offset else {})


def shift_view(disparity: np.ndarray, baselines: int) -> np.ndarray:
    """Show a disparity map from a view this many baselines to the right; NaN where it is hidden.

    Where several places fall on one pixel the nearest of them is visible.
    """
    rows, columns = np.nonzero(np.isfinite(disparity))
    values = disparity[rows, columns]
    columns = np.rint(columns - baselines * values).astype(np.int64)
    inside = (columns >= 0) & (columns < disparity.shape[1])
    out = np.full(disparity.shape, -np.inf, np.float32)
    np.maximum.at(out, (rows[inside], columns[inside]), values[inside])
    return np.where(np.isfinite(out), out, np.nan).astype(np.float32)


PAPER_SETTINGS: dict[str, tuple[float, float, float, float]] = {
    "cones": (0.9, 360, 225, 188),
    "dolls": (0.85, 1512, 695, 555),
    "moebius": (0.77, 1512, 695, 555),
    "rocks": (0.9, 1512, 638, 555),
    "cloth": (0.9, 1050, 641, 555),
}
"""Ratio, focal length and principal point in px, by scene, of the authors' notebooks."""

PAPER_FLANN_TREES = 10
PAPER_FLANN_CHECKS = 100


def pipelines(options: BenchmarkOptions) -> list[Pipeline]:
    """Return what is compared, chance baselines last."""
    native = options.native_detector()
    detectors = {Path(each).stem: native.with_weights(each) for each in options.geometry_weights}
    found: list[Pipeline] = []
    for name, detector in detectors.items():
        weights = file_digest(detector.weights)[:16]
        version = f"{weights} {detector.runtime} {detector.heatmap_options}"
        drawn = "" if found else "ours"
        ours = partial(_ours, detector=detector)
        found.append(Pipeline(f"ours, weights {name}", ours, version, drawn=drawn))
    for name, detector in detectors.items():
        squashed = detector.configured(HeatmapOptions(PAPER_RESOLUTION_PX, "bgr"))
        feature = deepdetect_feature(squashed, title=f"the paper's pipeline, weights {name}")
        found.append(_paper(feature, paper=FIGURE_8["DeepDetect"]))
    for name, drawn in (("sift", "SIFT default"), ("sift-low", "SIFT low")):
        if name in options.classical:
            feature = self_described(name)
            found.append(_paper(feature, drawn, FIGURE_8[feature.title]))
    random = partial(_random, like=next(iter(detectors.values())))
    every = partial(_ours, detector=AllPixels())
    return [
        *found,
        Pipeline("OpenCV's SGBM", sgbm),
        Pipeline("baseline: as many random pixels as ours", random, found[0].version, 1),
        Pipeline("baseline: all pixels", every),
        Pipeline("all pixels, --density 1", partial(every, density=1)),
    ]


def _ours(
    scene: CalibratedStereoPair, *, detector: AnyDetector, density: float | None = None
) -> Points:
    """Reconstruct as `deepdetect reconstruct --rectified`."""
    _compile_kernels()
    profiler = StageProfiler()
    found = reconstruct(
        scene.left,
        scene.right,
        detector,
        calibration=scene.calibration,
        rectified=True,
        selection=SelectionOptions(density=density),
        progress=lambda stage: profiler.record(stage if stage in STAGES else "geometry"),
    )
    profiler.record("geometry")
    assert found.disparity is not None
    filled = int(np.count_nonzero(~found.matched))
    return found.pixels, found.disparity, filled, profiler


def _random(scene: CalibratedStereoPair, *, like: DeepDetect) -> Points:
    """Reconstruct as many random pixels as a detector finds keypoints."""
    density = float((like.heatmap(scene.left) > 0.5).mean())
    return _ours(scene, detector=RandomDetector(), density=density)


def _paper(feature: LocalFeature, drawn: str = "", paper: Mapping[str, float] = {}) -> Pipeline:
    """Make the paper's pipeline with the keypoints and descriptors of a local feature."""

    def run(scene: CalibratedStereoPair) -> Points:
        feature.detect(scene.left)  # the first run of a size takes longer
        profiler = StageProfiler()
        points0, points1 = paper_points(feature, scene, profiler)
        disparity = (points0[:, 0] - points1[:, 0]).astype(np.float32)
        return points0.astype(np.float32), disparity, 0, profiler

    return Pipeline(feature.title, run, feature.version, 1, drawn, paper)


def paper_points(
    feature: LocalFeature, scene: CalibratedStereoPair, profiler: StageProfiler, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Match a stereo pair; return the (M, 2) points that the essential matrix leaves ("voxels").

    The number of points is that of one draw of RANSAC: other trees of FLANN, by another seed, or
    another order of the matches give up to 1 % more or less.
    """
    images = scene.left, scene.right
    ratio, camera_matrix = paper_settings(scene)
    features = [feature.detect(rgb) for rgb in images]
    profiler.record("keypoints")
    check_memory([len(one) for one in features])
    first, second = (feature.describe(rgb, one) for rgb, one in zip(images, features, strict=True))
    flann = partial(flann_neighbours, trees=PAPER_FLANN_TREES, checks=PAPER_FLANN_CHECKS)
    found = match_descriptors(first, second, flann, ratio=ratio, seed=seed)
    profiler.record("matching")
    kept = essential_inliers(
        features[0].xy[found.indices0].astype(np.float64),
        features[1].xy[found.indices1].astype(np.float64),
        camera_matrix,
    )
    profiler.record("geometry")
    return kept


def paper_settings(scene: CalibratedStereoPair) -> tuple[float, np.ndarray]:
    """Return the authors' ratio and camera matrix; of other scenes their most frequent ratio."""
    camera = scene.calibration.camera0.matrix
    own = 0.9, camera[0, 0], camera[0, 2], camera[1, 2]
    ratio, focal, x, y = PAPER_SETTINGS.get(scene.name, own)
    return ratio, np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]], float)


def essential_inliers(
    points0: np.ndarray, points1: np.ndarray, camera_matrix: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Keep the inliers of the essential matrix; triangulate them for the time that takes."""
    if len(points0) < 6:
        return points0[:0], points1[:0]
    essential, inliers = cv2.findEssentialMat(
        points0,
        points1,
        camera_matrix,
        method=cv2.RANSAC,
        prob=0.99999,
        threshold=0.5,
        maxIters=100_000,
    )
    if essential is None:
        return points0[:0], points1[:0]
    kept = inliers.ravel() > 0
    points0, points1 = points0[kept], points1[kept]
    _, rotation, translation, _ = cv2.recoverPose(essential[:3], points0, points1, camera_matrix)
    poses = np.eye(3, 4), np.column_stack([rotation, translation])
    cv2.triangulatePoints(*(camera_matrix @ pose for pose in poses), points0.T, points1.T)
    return points0, points1


def sgbm(scene: CalibratedStereoPair) -> Points:
    """Run OpenCV's semi-global matching on every pixel, in the range that ours finds.

    From 0 or below; both views are extended by it, so that there are values at the margins, too.
    """
    profiler = StageProfiler()
    gray = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (scene.left, scene.right)]
    search = find_disparity_range(*gray)
    smallest, largest = (0, 64) if search is None else (min(search[0], 0), search[1])
    count = max(16, -(-(largest - smallest + 1) // 16) * 16)
    borders = max(smallest + count, 0), -smallest
    disparity = sgbm_disparity(scene.left, scene.right, count, borders, smallest)
    rows, columns = np.nonzero(np.isfinite(disparity))
    profiler.record("matching")
    pixels = np.column_stack([columns, rows]).astype(np.float32)
    return pixels, disparity[rows, columns], 0, profiler


def sgbm_disparity(
    left: np.ndarray,
    right: np.ndarray,
    num_disparities: int,
    borders_px: tuple[int, int] = (0, 0),
    min_disparity: int = 0,
) -> np.ndarray:
    """Run OpenCV's semi-global matching on RGB views, extended by borders on the left and right.

    A multiple of 16 of disparities is tried. Returns (H, W) float32 in pixels, NaN without one.
    """
    matcher = cv2.StereoSGBM_create(
        minDisparity=min_disparity,
        numDisparities=num_disparities,
        blockSize=5,
        P1=8 * 3 * 25,
        P2=32 * 3 * 25,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    views = [
        cv2.copyMakeBorder(
            cv2.cvtColor(image, cv2.COLOR_RGB2BGR), 0, 0, *borders_px, cv2.BORDER_REPLICATE
        )
        for image in (left, right)
    ]
    inside = slice(borders_px[0], borders_px[0] + left.shape[1])
    disparity = matcher.compute(*views)[:, inside].astype(np.float32) / 16
    return np.where(disparity >= min_disparity, disparity, np.nan)


@lru_cache(maxsize=1)
def _compile_kernels() -> None:
    """Run once on a small scene, so that no scene's time includes the compilation."""
    scene = np.random.default_rng(0).integers(0, 256, (96, 160), np.uint8)
    scene = cv2.GaussianBlur(scene, (0, 0), 1)
    column, row = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in (160, 96)))
    right = cv2.remap(scene, column + 4 + row / 12, row, cv2.INTER_LINEAR)
    reconstruct(scene, right, AllPixels(), focal_px=100, rectified=True)


def score_stereo_matches(
    sources: Mapping[str, AnyDetector], pairs: Sequence[StereoPair], *, quiet: bool = True
) -> list[dict[str, Any]]:
    """Match rectified pairs with several sources of keypoints, and evaluate the matches.

    By descriptors alone over the whole image: neither the rows nor the true disparity are used. A
    source's rows are followed by those of random points at its density, since more keypoints always
    find more; all pixels come last.
    """
    rows: list[dict[str, Any]] = []
    with progress(len(pairs) * (2 * len(sources) + 1), "matching", "pair", quiet) as bar:

        def evaluate(source: str, pair: StereoPair, found: Matches) -> None:
            density = (found.keypoints0.density + found.keypoints1.density) / 2
            score = stereo_score(found.points0, found.points1, pair.disparity)
            rows.append({"source": source, "pair": pair.name, "density": density, **score})
            bar.update(1)

        for name, detector in sources.items():
            for pair in pairs:
                evaluate(name, pair, match_stereo(pair, detector))
            for pair, row in zip(pairs, rows[-len(pairs) :], strict=True):
                evaluate(f"random, as {name}", pair, match_random_points(pair, row["density"]))
        for pair in pairs:
            evaluate("all pixels", pair, match_stereo(pair, AllPixels()))
    return rows


def match_stereo(pair: StereoPair, detector: AnyDetector, density: float | None = None) -> Matches:
    """Match both views by descriptors alone and without estimating their geometry."""
    selection = SelectionOptions(density=density)
    return match_images(
        pair.left, pair.right, detector, selection=selection, guided_matching=False, model="none"
    )


def match_random_points(pair: StereoPair, density: float) -> Matches:
    """Match random points of a density, in keypoints per pixel: the chance baseline."""
    return match_stereo(pair, RandomDetector(), max(density, 1e-6))
