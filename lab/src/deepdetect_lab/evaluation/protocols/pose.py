"""Evaluate relative poses that are estimated from matches, in image pairs with known cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from deepdetect._shared.opencv import cv2
from deepdetect.detector.detector import DeepDetect
from deepdetect.matching.pipeline import match_images

from ...datasets.posed_images import PosedPair, PosedScene, load_posed_scenes
from ..baselines.method import LocalFeature
from ..baselines.opencv import STANDARD
from ..metrics.homography import area_under_curve
from ..metrics.pose import (
    EPIPOLAR_THRESHOLD_PX,
    POSE_THRESHOLDS_DEG,
    epipolar_inlier_ratio,
    rotation_error,
    translation_error,
)
from ..options import BenchmarkOptions, without_repeats
from ..report import (
    Columns,
    Row,
    Rows,
    Section,
    Table,
    average,
    median,
    tabulate,
    where,
)
from ..run import MatchSettings, Run
from ..unguided import UPRIGHT_SIFT, match_unguided

THRESHOLD_PX = 1.0
CONFIDENCE = 0.99999
MIN_MATCHES = 6
"""Any five matches fit some essential matrix exactly, so at least one more is needed."""

NO_FAR_POINTS = 1e9
"""OpenCV chooses one of an essential matrix's four poses by the number of points that are in front
of both cameras and nearer than this many baselines. The value is so large that all points count."""

BUDGET = 8192
RATIO = 0.8
GOOD_DEG = 5.0
"""A pose counts as correct if its error in degrees is below this. Chosen by hand."""

STRAIGHT_AHEAD = "no matches: straight ahead"

ERROR = "pose error, °"
AGREEING = f"agreeing within {EPIPOLAR_THRESHOLD_PX:g} px"

TEXT = (
    "The relative pose of two cameras is estimated from matches in the same way for all methods: "
    f"OpenCV's MAGSAC with a threshold of {THRESHOLD_PX:g} px and a confidence of {CONFIDENCE:g} "
    "estimates the essential matrix with the true intrinsics. It allows four poses, and the one "
    "with most points in front of both cameras is used. The error of a pose is the larger of two "
    "angles, the rotation error and the translation error. Methods differ in the matches. "
    '"DeepDetect": `match_images` with its defaults, which is guided matching. "DeepDetect, '
    'unguided": keypoints are matched by descriptors alone (patchmatch, mutual nearest '
    f"neighbours). All others: the best {BUDGET:,} keypoints are matched by exact mutual nearest "
    f"neighbours with ratio {RATIO:g}, or without ratio test if descriptors are learned.",
    f'"{STRAIGHT_AHEAD}" uses no image. It assumes no rotation, and the second camera in front of '
    "the first. For images from a moving car this guess is often nearly correct.",
    "Guided matching decides by thresholds whether a scene is a plane or has depth. The thresholds "
    "were chosen on Strecha's fountain and a KITTI clip, so these two scenes do not test them.",
)

NOTE = (
    "Failed: number of pairs for which no pose was found; their error counts as infinite. AUC: "
    "area under the cumulative error curve up to a threshold, as in SuperGlue and glue-factory, "
    "except that a translation in the opposite direction is wrong here. Matches: median over the "
    "pairs. Agreeing: fraction of the matches whose Sampson distance from the true epipolar "
    f"geometry is under {EPIPOLAR_THRESHOLD_PX:g} px, mean over the pairs; a pair without matches "
    "counts as 0."
)

Found = tuple[np.ndarray, np.ndarray, float, str]
"""Positions of the M matches in the two images, (M, 2) each; the seconds of matching; and the model
that guided it: "homography", "fundamental" or "none", or "" for methods without guidance."""


@dataclass(frozen=True, eq=False)
class PoseMethod:
    """A method that the benchmark compares, with its title in the tables.

    `match` finds the matches of two images. If `match` is None, the method guesses without images
    that the camera moves straight ahead. `name` and `version` identify cached results.
    """

    name: str
    title: str
    match: Callable[[tuple[Path, Path]], Found] | None = None
    version: tuple[Any, ...] = ()


def pose(run: Run, options: BenchmarkOptions) -> list[Section]:
    """Run the benchmark: estimate the relative pose of each pair of each scene by each method."""
    scenes = load_posed_scenes(run.folder("pose"), options.max_pairs)
    methods = pose_methods(run, options)
    items = {
        f"{scene.name} {k}": (scene, pair) for scene in scenes for k, pair in enumerate(scene.pairs)
    }

    def measure(method: PoseMethod, item: tuple[PosedScene, PosedPair]) -> Row:
        scene, pair = item
        return {"scene": scene.name, **pose_row(run, method, pair)}

    rows = run.rows("pose of ", methods, items, measure)
    tables = [scene_table(scenes, methods, rows)]
    return [Section("Relative poses", TEXT, tables)]


def pose_methods(run: Run, options: BenchmarkOptions) -> list[PoseMethod]:
    """Return the methods of DeepDetect, the chosen baselines, and the guess without images."""
    detector, own = options.native_detector(), options.deepdetect_native()
    ways = {"DeepDetect": _match_guided, "DeepDetect, unguided": _match_unguided}
    classical = [STANDARD[name] for name in ("sift", "orb") if name in options.classical]
    features = without_repeats((*classical, *options.others))
    return [
        *(
            PoseMethod(title, title, partial(match, detector), (*own.key, title))
            for title, match in ways.items()
        ),
        *(_feature_method(run, feature) for feature in features),
        PoseMethod("straight", STRAIGHT_AHEAD),
    ]


def _match_guided(detector: DeepDetect, images: tuple[Path, Path]) -> Found:
    found = match_images(*images, detector)
    geometry = found.geometry
    assert geometry is not None
    return found.points0, found.points1, sum(found.seconds.values()), geometry.model


def _match_unguided(detector: DeepDetect, images: tuple[Path, Path]) -> Found:
    how: dict[str, Any] = {"descriptor": UPRIGHT_SIFT, "matcher": "patchmatch", "mutual": True}
    found = match_unguided(*images, detector, **how)
    return found.points0, found.points1, sum(found.seconds.values()), ""


def _feature_method(run: Run, feature: LocalFeature) -> PoseMethod:
    ratio, test = (math.inf, "no ratio test") if feature.learned else (RATIO, f"ratio {RATIO:g}")
    settings = MatchSettings("exact", ratio, mutual=True, budget=BUDGET)

    def match(images: tuple[Path, Path]) -> Found:
        detect = [run.keypoints(feature, image)[1] for image in images]
        found = run.matches(feature, images, settings)
        seconds = sum(detect) + found.seconds
        return found.points0, found.points1, seconds, ""

    title = f"{feature.title}, {test}"
    return PoseMethod(feature.name, title, match, (*feature.key, settings))


def pose_row(run: Run, method: PoseMethod, pair: PosedPair) -> Row:
    """Measure a method on a pair, or read the result from the cache; return values by column title.

    Errors are in degrees, and infinite without a pose. If the method guesses without images, all
    other values are None.
    """
    match = method.match
    images = (pair.first.path, pair.second.path)
    cameras = (pair.first.camera.matrix, pair.second.camera.matrix)

    def make() -> Row:
        assert match is not None
        points0, points1, seconds, guided_by = match(images)
        return {
            **pose_errors(estimate_pose(points0, points1, *cameras), pair),
            "matches": len(points0),
            AGREEING: epipolar_inlier_ratio(points0, points1, pair.fundamental),
            "seconds": seconds,
            "guided by": guided_by,
        }

    if match is None:
        nothing: Row = dict.fromkeys(("matches", AGREEING, "seconds", "guided by"))
        return pose_errors((np.eye(3), np.array([0.0, 0.0, -1.0])), pair) | nothing
    truth = (*cameras, pair.rotation, pair.translation)
    estimate = (THRESHOLD_PX, CONFIDENCE, EPIPOLAR_THRESHOLD_PX)
    row = run.cached("pose", (method.name, method.version, images, truth, estimate), make)
    return row | {"guided by": row["guided by"] or None}


def pose_errors(pose: tuple[np.ndarray, np.ndarray] | None, pair: PosedPair) -> Row:
    """Return the errors of a pose in degrees by column title. They are infinite without a pose."""
    rotation = translation = float("inf")
    if pose is not None:
        rotation = rotation_error(pose[0], pair.rotation)
        translation = translation_error(pose[1], pair.translation)
    errors = {"rotation error, °": rotation, "translation error, °": translation}
    return {**errors, ERROR: max(rotation, translation)}


def estimate_pose(
    points0: np.ndarray, points1: np.ndarray, intrinsics0: np.ndarray, intrinsics1: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Estimate the relative pose of two cameras from (M, 2) matches; return None on failure.

    Returns the (3, 3) rotation and the (3,) translation, which has length 1. They map a point from
    the first camera's coordinates to the second's: X1 = rotation @ X0 + translation.
    """
    if len(points0) < MIN_MATCHES:
        return None
    # The intrinsics may differ, so positions are mapped to one camera with the mean focal length.
    # With a focal length of 1, OpenCV 5's MAGSAC is less accurate (median rotation error of SIFT on
    # a KITTI clip: 0.13 instead of 0.05 degrees).
    focal = float(np.mean([k[i, i] for k in (intrinsics0, intrinsics1) for i in (0, 1)]))
    camera = np.diag([focal, focal, 1.0])
    first = _of_camera(points0, intrinsics0, camera)
    second = _of_camera(points1, intrinsics1, camera)
    try:
        essential, inliers = cv2.findEssentialMat(
            first, second, camera, method=cv2.USAC_MAGSAC, prob=CONFIDENCE, threshold=THRESHOLD_PX
        )
        if essential is None or essential.shape != (3, 3) or not np.isfinite(essential).all():
            return None
        _, rotation, translation, *_ = cv2.recoverPose(
            essential, first, second, camera, distanceThresh=NO_FAR_POINTS, mask=inliers
        )
    except cv2.error:  # the matches are degenerate, for example all at one place
        return None
    return rotation, translation.ravel()


def _of_camera(points: np.ndarray, intrinsics: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Map positions from an image with these intrinsics to another camera with the same pose."""
    homogeneous = np.column_stack([np.asarray(points, np.float64), np.ones(len(points))])
    return np.ascontiguousarray((homogeneous @ (camera @ np.linalg.inv(intrinsics)).T)[:, :2])


def _auc(own: Rows, threshold: float) -> float | None:
    return area_under_curve([row[ERROR] for row in own], threshold) if own else None


SUMMARY: Columns = {
    "pairs": (",d", len),
    "failed": (",d", lambda own: sum(row[ERROR] == float("inf") for row in own)),
    **{
        f"AUC at {threshold:g}°": (".3f", partial(_auc, threshold=threshold))
        for threshold in POSE_THRESHOLDS_DEG
    },
    "median error, °": median(".2f", ERROR),
    "matches": median(",.0f", "matches"),
    AGREEING: average(".1%", AGREEING),
}


def scene_table(scenes: Sequence[PosedScene], methods: Sequence[PoseMethod], rows: Rows) -> Table:
    """Tabulate each method on each scene, with the numbers of pairs better and worse than SIFT."""
    sift = {row["item"]: row[ERROR] < GOOD_DEG for row in where(rows, method="sift")}

    def against_sift(own: Rows, only_sift: bool) -> int | None:
        compared = [row for row in own if row["item"] in sift and row["method"] != "sift"]
        right = [(row[ERROR] < GOOD_DEG, sift[row["item"]]) for row in compared]
        return right.count((not only_sift, only_sift)) if right else None

    def guided(own: Rows, model: str) -> int | None:
        models = [row["guided by"] for row in own]
        return models.count(model) if set(models) - {None} else None

    columns: Columns = {
        **SUMMARY,
        "guided by homography": (",d", partial(guided, model="homography")),
        "guided by fundamental": (",d", partial(guided, model="fundamental")),
        "unguided": (",d", partial(guided, model="none")),
        "worse than SIFT": (",d", partial(against_sift, only_sift=True)),
        "better than SIFT": (",d", partial(against_sift, only_sift=False)),
        "seconds": median(".2f", "seconds"),
    }
    note = (
        f"{NOTE} Guided by: number of pairs that a homography or a fundamental matrix guided; "
        "unguided: pairs for which no geometry was trusted. Worse than SIFT: number of "
        f"pairs with an error of {GOOD_DEG:g}° or more, while SIFT's is under {GOOD_DEG:g}°; "
        "better: the reverse. Seconds: median time from images to matches."
    )
    groups = [{"scene": scene.name} for scene in scenes]
    return tabulate("pose", "Relative poses", methods, rows, columns, note, groups)
