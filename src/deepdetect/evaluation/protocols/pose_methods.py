"""The methods whose relative poses are compared, and the estimator that all of them share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ..._shared.opencv import cv2
from ...datasets.posed_images import PosedPair
from ...detector.detector import DeepDetect
from ...detector.heatmap import HeatmapOptions
from ...matching.options import MatchingOptions
from ...matching.pipeline import match_images
from ..baselines.method import LocalFeature
from ..baselines.opencv import CLASSICAL, STANDARD
from ..context import BenchmarkContext, MatchSettings, feature_key
from ..options import BenchmarkOptions, without_repeats

THRESHOLD_PX = 1.0
CONFIDENCE = 0.99999
MIN_MATCHES = 6
"""One more than give an essential matrix: with five each is perfect."""

NO_FAR_POINTS = 1e9
"""OpenCV leaves points beyond this many baselines out when it chooses one of four poses."""

BUDGET = 8192
RATIO = 0.8

DEEPDETECT = "DeepDetect"
SIFT = f"SIFT, ratio {RATIO:g}"
STRAIGHT_AHEAD = "no matches: straight ahead"

Pose = tuple[np.ndarray, np.ndarray]
"""(3, 3) rotation and (3,) translation: X1 = rotation @ X0 + translation."""


@dataclass(frozen=True, eq=False)
class FoundMatches:
    """The matches of a pair.

    Attributes:
        points0, points1: (M, 2) matched positions.
        seconds: from the images to the matches.
        guided_by: "homography", "fundamental" or "none"; None for methods that are never guided.
    """

    points0: np.ndarray
    points1: np.ndarray
    seconds: float
    guided_by: str | None = None


@dataclass(frozen=True, eq=False)
class PoseMethod:
    """A row of the tables.

    Attributes:
        title: how tables name it.
        match: finds the matches of a pair; None: there are none, the pose is always the same.
        key: returns what the matches of a pair depend on, for the cache.
    """

    title: str
    match: Callable[[PosedPair], FoundMatches] | None = None
    key: Callable[[PosedPair], Mapping[str, Any]] = lambda pair: {}


def pose_methods(context: BenchmarkContext, options: BenchmarkOptions) -> list[PoseMethod]:
    """Return DeepDetect's rows, the baselines that were chosen, and the control."""
    heatmap = HeatmapOptions("native", options.channels)
    detector = options.detector.configured(heatmap)
    own = options.deepdetect_native()
    ways: dict[str, dict[str, Any]] = {
        DEEPDETECT: {},
        f"{DEEPDETECT}, unguided": {"guided_matching": False, "mutual": True},
    }
    chosen = {"sift": CLASSICAL["sift"], "orb": STANDARD["orb"]}
    classical = [feature for name, feature in chosen.items() if name in options.classical]
    return [
        *(
            PoseMethod(title, partial(_match_images, detector, way), partial(_own_key, own, way))
            for title, way in ways.items()
        ),
        *(
            _feature_method(context, feature)
            for feature in without_repeats((*classical, *options.others))
        ),
        PoseMethod(STRAIGHT_AHEAD),
    ]


def _match_images(detector: DeepDetect, way: Mapping[str, Any], pair: PosedPair) -> FoundMatches:
    options = MatchingOptions(matcher="patchmatch")
    found = match_images(
        pair.first.path, pair.second.path, detector, model="none", options=options, **way
    )
    guided_by = found.two_view_geometry.model if found.two_view_geometry is not None else None
    return FoundMatches(found.points0, found.points1, sum(found.seconds.values()), guided_by)


def _own_key(feature: LocalFeature, way: Mapping[str, Any], pair: PosedPair) -> Mapping[str, Any]:
    return {**feature_key(feature, (pair.first.path, pair.second.path)), "match_images": dict(way)}


def _feature_method(context: BenchmarkContext, feature: LocalFeature) -> PoseMethod:
    """Match exactly, with the ratio test; learned descriptors without it."""
    ratio = 1.0 if feature.learned else RATIO
    settings = MatchSettings("exact", ratio, mutual=True, budget=BUDGET)
    test = "no ratio test" if feature.learned else f"ratio {RATIO:g}"

    def match(pair: PosedPair) -> FoundMatches:
        images = (pair.first.path, pair.second.path)
        detect = [context.keypoints(feature, image).profile.seconds for image in images]
        found = context.matches(feature, images, settings)
        seconds = sum(detect) + found.describe.seconds + found.match.seconds
        return FoundMatches(found.points0, found.points1, seconds)

    def key(pair: PosedPair) -> Mapping[str, Any]:
        images = (pair.first.path, pair.second.path)
        return {**feature_key(feature, images), "settings": vars(settings)}

    return PoseMethod(f"{feature.title}, {test}", match, key)


def straight_ahead() -> Pose:
    """Return the pose of a camera that moved forward without turning.

    The second camera lies at (0, 0, 1) of the first's frame, so the translation is (0, 0, -1).
    """
    return np.eye(3), np.array([0.0, 0.0, -1.0])


def estimate_pose(
    points0: np.ndarray, points1: np.ndarray, intrinsics0: np.ndarray, intrinsics1: np.ndarray
) -> Pose | None:
    """Estimate the relative pose of two cameras from matches, the same way for all methods.

    An essential matrix by OpenCV's MAGSAC at `THRESHOLD_PX`, then that of its four poses with most
    points in front of both cameras.

    Args:
        points0, points1: (M, 2) matched positions in pixels.
        intrinsics0, intrinsics1: (3, 3) camera matrices.

    Returns:
        The pose with a translation of length 1; None with too few matches, or where there is none.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> points = rng.uniform((-4, -3, 8), (4, 3, 16), (200, 3))
        >>> camera = np.array([[500, 0, 320], [0, 500, 240], [0, 0, 1.0]])
        >>> first, second = ((p / p[:, 2:] @ camera.T)[:, :2] for p in (points, points - [1, 0, 0]))
        >>> rotation, translation = estimate_pose(first, second, camera, camera)
        >>> bool(np.allclose(translation, [-1, 0, 0], atol=1e-3))
        True
    """
    if len(points0) < MIN_MATCHES:
        return None
    # Of a common camera, so that both images may have any intrinsics. It has the mean focal length,
    # not 1: in normalised coordinates the MAGSAC of OpenCV 5 is less accurate (SIFT on 87 pairs of
    # a KITTI clip: median rotation error 0.13 instead of 0.05 degrees).
    focal = float(np.mean([k[i, i] for k in (intrinsics0, intrinsics1) for i in (0, 1)]))
    camera = np.diag([focal, focal, 1.0])
    first = _of_camera(points0, intrinsics0, camera)
    second = _of_camera(points1, intrinsics1, camera)
    try:
        essential, inliers = cv2.findEssentialMat(
            first,
            second,
            camera,
            method=cv2.USAC_MAGSAC,
            prob=CONFIDENCE,
            threshold=THRESHOLD_PX,
        )
        if essential is None or essential.shape != (3, 3) or not np.isfinite(essential).all():
            return None
        _, rotation, translation, *_ = cv2.recoverPose(
            essential, first, second, camera, distanceThresh=NO_FAR_POINTS, mask=inliers
        )
    except cv2.error:  # degenerate input, as all points in one place
        return None
    return rotation, translation.ravel()


def _of_camera(points: np.ndarray, intrinsics: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Move positions to where another camera without rotation sees them."""
    homogeneous = np.column_stack([np.asarray(points, np.float64), np.ones(len(points))])
    return np.ascontiguousarray((homogeneous @ (camera @ np.linalg.inv(intrinsics)).T)[:, :2])
