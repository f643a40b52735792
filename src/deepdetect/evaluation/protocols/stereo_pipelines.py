"""What reconstructs a rectified pair: ours, the published pipeline, SIFT, OpenCV's SGBM.

Each is a function from a scene to its points with their disparities, and meters its stages under
three names: keypoints, matching, geometry.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np

from ...datasets.types import CalibratedStereoPair
from ...detector.detector import DeepDetect, HeatmapDetector
from ...detector.heatmap import HeatmapOptions
from ...reconstruction.pipeline import reconstruct
from ...reconstruction.stereo.matching import find_disparity_range
from ..baselines import CLASSICAL
from ..baselines.sift import low_sift
from ..cache import file_digest
from ..controls import EveryPixel
from ..metering import Meter, StageMeters
from ..options import BenchmarkOptions
from .paper_numbers import SIFT_LOW_POINTS, STEREO_POINTS
from .published_pipeline import published_detector
from .published_stereo import (
    StereoSettings,
    published_points,
    sift_points,
    stereo_settings,
)

STAGES = ("keypoints", "matching", "geometry")
ROUNDS = 3
"""Runs of what takes seconds; the one of median time is told."""

PUBLISHED = "published pipeline"


@dataclass(frozen=True, eq=False)
class StereoPoints:
    """The points of a scene.

    Attributes:
        pixels: (N, 2) float32 positions in the left image.
        disparity: (N,) float32 in pixels.
        filled: how many of them were not matched, but filled in.
        meters: of each of `STAGES` that the pipeline has.
        memory: bytes that the process grew by at the most, over all stages.
        run: the run that measured them; results in the cache keep theirs.
    """

    pixels: np.ndarray
    disparity: np.ndarray
    filled: int
    meters: Mapping[str, Meter]
    memory: int
    run: int = 0

    @property
    def seconds(self) -> float:
        """Of all stages."""
        return sum(meter.seconds for meter in self.meters.values())


@dataclass(frozen=True, eq=False)
class Pipeline:
    """A way from two images to points.

    Attributes:
        title: how tables name it.
        run: reconstructs a scene.
        version: what results depend on besides the title.
        rounds: how often it is run for its time.
        drawn: its title in Figure 8; empty: not drawn.
        paper: the points in the paper by scene.
    """

    title: str
    run: Callable[[CalibratedStereoPair], StereoPoints]
    version: str = ""
    rounds: int = ROUNDS
    drawn: str = ""
    paper: Mapping[str, int] = field(default_factory=dict)


def pipelines(options: BenchmarkOptions) -> list[Pipeline]:
    """Return what is compared, controls last."""
    found = []
    for name, detector in options.geometry_detectors().items():
        version = (
            f"{file_digest(detector.weights)[:16]} {detector.backend} {detector.heatmap_options}"
        )
        drawn = "ours" if not found else ""
        found.append(Pipeline(f"ours, weights {name}", _ours(detector), version, drawn=drawn))
    for name, detector in options.geometry_detectors().items():
        squashing = detector.configured(HeatmapOptions(480, "bgr"))
        title, version = f"{PUBLISHED}, weights {name}", file_digest(detector.weights)[:16]
        run = _published(squashing)
        found.append(Pipeline(title, run, version, 1, paper=STEREO_POINTS))
    for name, make, drawn, paper in (
        ("sift", cv2.SIFT_create, "SIFT default", {}),
        ("sift-low", low_sift, "SIFT low", SIFT_LOW_POINTS),
    ):
        if name in options.classical:
            method = CLASSICAL[name]
            found.append(Pipeline(method.title, _sift(make), method.version, 1, drawn, paper))
    found.append(Pipeline("OpenCV's SGBM", sgbm))
    detector = next(iter(options.geometry_detectors().values()))
    version = file_digest(detector.weights)[:16]
    found.append(Pipeline("control: as many random pixels as ours", _random(detector), version, 1))
    found.append(Pipeline("control: every pixel", _ours(EveryPixel())))
    found.append(Pipeline("every pixel, --density 1", _ours(EveryPixel(), density=1)))
    return found


def _ours(
    detector: HeatmapDetector, density: float | None = None
) -> Callable[[CalibratedStereoPair], StereoPoints]:
    def run(scene: CalibratedStereoPair) -> StereoPoints:
        _compiled()
        return _reconstructed(scene, detector, density)

    return run


def _reconstructed(
    scene: CalibratedStereoPair, detector: HeatmapDetector, density: float | None
) -> StereoPoints:
    meters = StageMeters()

    def done(stage: str) -> None:
        meters.lap(stage if stage in STAGES else "geometry")

    found = reconstruct(
        scene.left,
        scene.right,
        detector,
        calibration=scene.calibration,
        rectified=True,
        density=density,
        progress=done,
    )
    meters.lap("geometry")
    assert found.disparity is not None
    filled = int(np.count_nonzero(~found.matched))
    return StereoPoints(found.pixels, found.disparity, filled, meters.stages, meters.memory)


def _random(like: DeepDetect) -> Callable[[CalibratedStereoPair], StereoPoints]:
    def run(scene: CalibratedStereoPair) -> StereoPoints:
        _compiled()
        density = float((like.heatmap(scene.left) > 0.5).mean())
        generator = np.random.default_rng(0)

        class Points:
            def heatmap(self, image: np.ndarray) -> np.ndarray:
                return generator.random(image.shape[:2], dtype=np.float32)

        return _reconstructed(scene, Points(), density)

    return run


def _published(detector: DeepDetect) -> Callable[[CalibratedStereoPair], StereoPoints]:
    def run(scene: CalibratedStereoPair) -> StereoPoints:
        network = published_detector(detector)
        network.heatmap(scene.left)  # the first run of a size takes longer
        meters = StageMeters()
        found = published_points((scene.left, scene.right), network, _settings(scene), meters.lap)
        return _from_matches(*found, meters)

    return run


def _sift(make: Callable[[], cv2.SIFT]) -> Callable[[CalibratedStereoPair], StereoPoints]:
    def run(scene: CalibratedStereoPair) -> StereoPoints:
        meters = StageMeters()
        found = sift_points((scene.left, scene.right), make(), _settings(scene), meters.lap)
        return _from_matches(*found, meters)

    return run


def _settings(scene: CalibratedStereoPair) -> StereoSettings:
    return stereo_settings(scene.name, scene.calibration.camera0.matrix)


def sgbm(scene: CalibratedStereoPair) -> StereoPoints:
    """Run OpenCV's semi-global matching on every pixel.

    With the range that ours finds, made a multiple of 16. Both views are continued on the left by
    that range, so that it gives values at the left margin, too.
    """
    meters = StageMeters()
    gray = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (scene.left, scene.right)]
    search = find_disparity_range(*gray)
    largest = 64 if search is None else search.max_disparity
    count = max(16, -(-(largest + 1) // 16) * 16)
    disparity = sgbm_disparity(scene.left, scene.right, count, count)
    rows, columns = np.nonzero(np.isfinite(disparity))
    meters.lap("matching")
    pixels = np.column_stack([columns, rows]).astype(np.float32)
    return StereoPoints(pixels, disparity[rows, columns], 0, meters.stages, meters.memory)


def sgbm_disparity(left: np.ndarray, right: np.ndarray, count: int, frame: int) -> np.ndarray:
    """Run OpenCV's semi-global matching: block 5, three ways, uniqueness 10, speckle filter.

    Args:
        left, right: (H, W, 3) uint8 RGB.
        count: disparities that are tried, from 0; a multiple of 16.
        frame: columns by which both views are continued on the left.

    Returns:
        (H, W) float32 in pixels, NaN where it gives none.
    """
    matcher = cv2.StereoSGBM_create(
        minDisparity=0,
        numDisparities=count,
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
            cv2.cvtColor(image, cv2.COLOR_RGB2BGR), 0, 0, frame, 0, cv2.BORDER_REPLICATE
        )
        for image in (left, right)
    ]
    disparity = matcher.compute(*views)[:, frame:].astype(np.float32) / 16
    return np.where(disparity >= 0, disparity, np.nan)


def _from_matches(points0: np.ndarray, points1: np.ndarray, meters: StageMeters) -> StereoPoints:
    disparity = (points0[:, 0] - points1[:, 0]).astype(np.float32)
    return StereoPoints(points0.astype(np.float32), disparity, 0, meters.stages, meters.memory)


@lru_cache(maxsize=1)
def _compiled() -> None:
    """Run once on little, so that no scene's time holds the compilation."""
    scene = np.random.default_rng(0).integers(0, 256, (96, 160), np.uint8)
    scene = cv2.GaussianBlur(scene, (0, 0), 1)
    column, row = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in (160, 96)))
    right = cv2.remap(scene, column + 4 + row / 12, row, cv2.INTER_LINEAR)
    reconstruct(scene, right, EveryPixel(), focal_px=100, rectified=True)
