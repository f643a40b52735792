"""Find points with disparities by DeepDetect, the paper's pipeline, SGBM and chance baselines."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from deepdetect._shared.opencv import cv2
from deepdetect._shared.records import file_digest
from deepdetect.detector.detector import AnyDetector, DeepDetect
from deepdetect.detector.heatmap import HeatmapOptions
from deepdetect.features.matchers import flann_neighbours, match_descriptors
from deepdetect.features.selection import SelectionOptions
from deepdetect.matching.pipeline import check_memory
from deepdetect.matching.stereo.matching import find_disparity_range
from deepdetect.reconstruction.pipeline import reconstruct

from ...datasets.middlebury import CalibratedStereoPair
from ..baselines.method import LocalFeature, deepdetect_feature
from ..baselines.opencv import self_described
from ..baselines.random import AllPixels, RandomDetector
from ..options import PAPER_RESOLUTION_PX, BenchmarkOptions
from .paper_numbers import FIGURE_8

ROUNDS = 3
"""Default number of timed runs of a pipeline; the median time is reported. Chosen by hand."""

Points = tuple[np.ndarray, np.ndarray, int]
"""The result of a pipeline: pixels of points in the left image, (N, 2); their disparities, (N,);
and the number of disparities that were filled in instead of matched."""


@dataclass(frozen=True, eq=False)
class Pipeline:
    """A pipeline that finds disparities in a stereo pair. `name` is its title in tables.

    `prepare` does untimed work and returns the function to time, which is run `rounds` times.
    `name` and `version` identify cached results. `drawn` is the title in Figure 8, or "" if the
    pipeline is not drawn there. `paper` maps scenes to the numbers of points that the paper prints.
    """

    name: str
    prepare: Callable[[CalibratedStereoPair], Callable[[], Points]]
    version: str = ""
    rounds: int = ROUNDS
    drawn: str = ""
    paper: Mapping[str, float] = field(default_factory=dict)


PAPER_SETTINGS: dict[str, tuple[float, float, float, float]] = {
    "cones": (0.9, 360, 225, 188),
    "dolls": (0.85, 1512, 695, 555),
    "moebius": (0.77, 1512, 695, 555),
    "rocks": (0.9, 1512, 638, 555),
    "cloth": (0.9, 1050, 641, 555),
}
"""Settings for each scene from the notebooks of the paper's authors: the threshold of the ratio
test, and in pixels the focal length, and x and y of the principal point."""

PAPER_FLANN_TREES = 10
PAPER_FLANN_CHECKS = 100


def pipelines(options: BenchmarkOptions) -> list[Pipeline]:
    """Return the pipelines that the benchmark compares, chance baselines last."""
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
        Pipeline("OpenCV's SGBM", lambda scene: partial(sgbm, scene)),
        Pipeline("baseline: as many random pixels as ours", random, found[0].version, 1),
        Pipeline("baseline: all pixels", every),
        Pipeline("all pixels, --density 1", partial(every, density=1)),
    ]


def _ours(
    scene: CalibratedStereoPair, *, detector: AnyDetector, density: float | None = None
) -> Callable[[], Points]:
    def run() -> Points:
        how: dict[str, Any] = {"calibration": scene.calibration, "rectified": True}
        selection = SelectionOptions(density=density)
        found = reconstruct(scene.left, scene.right, detector, selection=selection, **how)
        assert found.disparity is not None
        return found.pixels, found.disparity, int(np.count_nonzero(~found.matched))

    _compile_kernels()
    return run


def _random(scene: CalibratedStereoPair, *, like: DeepDetect) -> Callable[[], Points]:
    density = float((like.heatmap(scene.left) > 0.5).mean())
    return _ours(scene, detector=RandomDetector(), density=density)


def _paper(feature: LocalFeature, drawn: str = "", paper: Mapping[str, float] = {}) -> Pipeline:
    def run(scene: CalibratedStereoPair) -> Points:
        points0, points1 = paper_points(feature, scene)
        disparity = (points0[:, 0] - points1[:, 0]).astype(np.float32)
        return points0.astype(np.float32), disparity, 0

    def prepare(scene: CalibratedStereoPair) -> Callable[[], Points]:
        feature.detect(scene.left)  # the first run of a network at an image size takes longer
        return partial(run, scene)

    return Pipeline(feature.title, prepare, feature.version, 1, drawn, paper)


def paper_points(
    feature: LocalFeature, scene: CalibratedStereoPair, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Match a stereo pair as the paper does; return the matched positions in both images, (M, 2).

    Only inliers of an essential matrix are returned, and the paper calls these inliers voxels.
    Their number varies by up to 1 % with the seed, because FLANN and RANSAC choose at random.
    """
    images = scene.left, scene.right
    ratio, camera_matrix = paper_settings(scene)
    features = [feature.detect(rgb) for rgb in images]
    check_memory([len(one) for one in features])
    first, second = (feature.describe(rgb, one) for rgb, one in zip(images, features, strict=True))
    flann = partial(flann_neighbours, trees=PAPER_FLANN_TREES, checks=PAPER_FLANN_CHECKS)
    found = match_descriptors(first, second, flann, ratio=ratio, seed=seed)
    return essential_inliers(
        features[0].xy[found.indices0].astype(np.float64),
        features[1].xy[found.indices1].astype(np.float64),
        camera_matrix,
    )


def paper_settings(scene: CalibratedStereoPair) -> tuple[float, np.ndarray]:
    """Return the threshold of the ratio test and the (3, 3) camera matrix for a scene.

    Scenes that are not in `PAPER_SETTINGS` get the ratio 0.9 and their own camera matrix.
    """
    camera = scene.calibration.camera0.matrix
    own = 0.9, camera[0, 0], camera[0, 2], camera[1, 2]
    ratio, focal, x, y = PAPER_SETTINGS.get(scene.name, own)
    return ratio, np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]], float)


def essential_inliers(
    points0: np.ndarray, points1: np.ndarray, camera_matrix: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the matches that are inliers of the essential matrix.

    They are also triangulated, because the paper's pipeline does so and its time is measured.
    """
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
    """Match every pixel by OpenCV's semi-global matching.

    The range of disparities is that of `find_disparity_range`, extended to start at 0 or below.
    The views are padded by this range, so that pixels near the borders also get disparities.
    """
    gray = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (scene.left, scene.right)]
    search = find_disparity_range(*gray)
    smallest, largest = (0, 64) if search is None else (min(search[0], 0), search[1])
    count = max(16, -(-(largest - smallest + 1) // 16) * 16)
    borders = max(smallest + count, 0), -smallest
    disparity = sgbm_disparity(scene.left, scene.right, count, borders, smallest)
    rows, columns = np.nonzero(np.isfinite(disparity))
    pixels = np.column_stack([columns, rows]).astype(np.float32)
    return pixels, disparity[rows, columns], 0


def sgbm_disparity(
    left: np.ndarray,
    right: np.ndarray,
    num_disparities: int,
    borders_px: tuple[int, int] = (0, 0),
    min_disparity: int = 0,
) -> np.ndarray:
    """Match two rectified RGB views by OpenCV's semi-global matching.

    The views are padded on the left and right by `borders_px`. The matcher tries `num_disparities`
    values, a multiple of 16, from `min_disparity` on. Returns the disparities of the left view in
    pixels, (H, W) float32, NaN where none was found.
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
    """Reconstruct a small synthetic scene once, so that no measured time includes compilation."""
    scene = np.random.default_rng(0).integers(0, 256, (96, 160), np.uint8)
    scene = cv2.GaussianBlur(scene, (0, 0), 1)
    column, row = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in (160, 96)))
    right = cv2.remap(scene, column + 4 + row / 12, row, cv2.INTER_LINEAR)
    reconstruct(scene, right, AllPixels(), focal_px=100, rectified=True)
