"""Robust estimation of the geometry between two images: RANSAC or MAGSAC."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .._shared.errors import OptionError, unknown_name
from .._shared.opencv import cv2
from .._shared.options import check_ranges, suggest_keywords
from .parallax import measure_parallax
from .residuals import epipolar_errors, transfer_errors

ESTIMATORS = ("magsac", "ransac")
MODEL_NAMES = ("auto", "homography", "fundamental", "essential", "none")

MIN_MATCHES = {"homography": 4, "fundamental": 15, "essential": 6}
"""With fewer than 15 matches OpenCV's RANSAC ignores the threshold of a fundamental matrix."""


@suggest_keywords
@dataclass(frozen=True, eq=False)
class GeometryOptions:
    """How a geometry is estimated.

    Attributes:
        estimator: "magsac" or "ransac".
        inlier_threshold: a match is an inlier when its error is below this, in pixels: the
            transfer error of a homography, else the Sampson distance (in a rectified pair an
            error of d rows counts as d / sqrt(2)).
        homography: a given (3, 3) homography: nothing is estimated, the inliers are the matches
            whose transfer error is below the threshold.
        camera0, camera1: (3, 3) camera matrices, for the model "essential".
        confidence: desired probability that the model is the best one.
        iterations: maximum number.

    Raises:
        OptionError: a value is unknown, missing or out of its range.
    """

    estimator: str = "magsac"
    inlier_threshold: float = 1.0
    homography: np.ndarray | None = field(default=None, repr=False)
    camera0: np.ndarray | None = field(default=None, repr=False)
    camera1: np.ndarray | None = field(default=None, repr=False)
    confidence: float = 0.999
    iterations: int = 10_000

    def __post_init__(self) -> None:
        if self.estimator not in ESTIMATORS:
            raise unknown_name("estimator", self.estimator, ESTIMATORS)
        if not 0 < self.confidence < 1:
            raise OptionError(f"the confidence must lie between 0 and 1, not {self.confidence}")
        check_ranges(
            self,
            positive=("inlier_threshold", "iterations"),
        )
        for name in ("homography", "camera0", "camera1"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _matrix(name, getattr(self, name)))


def _matrix(name: str, value: Any) -> np.ndarray:
    """Return a copy of a (3, 3) matrix, validated."""
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise OptionError(f"{name} must be a (3, 3) matrix of finite numbers")
    if name != "homography" and (np.linalg.matrix_rank(matrix) < 3 or matrix[0, 0] <= 0):
        raise OptionError(
            f"{name} is not a camera matrix: it must be invertible, with a focal length above 0"
        )
    return matrix


@suggest_keywords
@dataclass(frozen=True, eq=False, repr=False)
class Geometry:
    """An estimated geometry.

    Attributes:
        model: "homography", "fundamental", "essential" or "none".
        matrix: (3, 3) float64, or None when nothing could be estimated. A homography
            maps the first image to the second; for the others x1^T M x0 = 0 (essential:
            in normalised coordinates).
        inliers: (M,) bool, the matches that agree with it.
    """

    model: str
    matrix: np.ndarray | None
    inliers: np.ndarray

    def __repr__(self) -> str:
        found = np.count_nonzero(self.inliers)
        return f"Geometry(model={self.model!r}, {found} inliers of {len(self.inliers)} matches)"


@suggest_keywords
def estimate_geometry(
    points0: np.ndarray,
    points1: np.ndarray,
    model: str = "fundamental",
    *,
    seed: int = 0,
    options: GeometryOptions = GeometryOptions(),
) -> Geometry:
    """Estimate the geometry between two images from matches, some of which are wrong.

    Args:
        points0, points1: (M, 2) matched positions, centre of the first pixel (0, 0).
        model: "homography" (planes, pure rotation), "fundamental" (any static scene), "auto"
            (one of these two; `measure_parallax`), "essential" (known cameras), or "none".
        seed: of the random samples.
        options: how.

    Returns:
        The geometry; its inliers are the matches with an error below the threshold. With too few
        matches, or when estimation fails, the matrix is None and no match is an inlier.

    Raises:
        OptionError: the model is unknown, or needs cameras that are not in the options.

    Example:
        >>> a = np.array([[0, 0], [9, 0], [9, 9], [0, 9], [4, 5]], float)
        >>> geometry = estimate_geometry(a, a + 3, "homography")
        >>> geometry
        Geometry(model='homography', 5 inliers of 5 matches)
        >>> geometry.matrix[:2, 2].round(3).tolist()
        [3.0, 3.0]
    """
    check_model(model, seed, options)
    points0 = np.asarray(points0, np.float64).reshape(-1, 2)
    points1 = np.asarray(points1, np.float64).reshape(-1, 2)
    if options.homography is not None:
        errors = transfer_errors(points0, points1, options.homography)
        return Geometry("homography", options.homography, errors < options.inlier_threshold)
    if model == "none":
        return Geometry("none", None, np.ones(len(points0), bool))
    if model == "auto":
        plane, depth = (
            estimate_geometry(points0, points1, each, seed=seed, options=options)
            for each in ("homography", "fundamental")
        )
        if plane.matrix is None or depth.matrix is None:
            return depth if plane.matrix is None else plane
        parallax = measure_parallax(points0, points1, plane.matrix, seed=seed)
        return depth if parallax.shows_depth else plane
    nothing = Geometry(model, None, np.zeros(len(points0), bool))
    if len(points0) < MIN_MATCHES[model]:
        return nothing
    # OpenCV draws the same samples every time; another order of the matches draws others.
    order = np.random.default_rng(seed).permutation(len(points0))
    try:
        matrix = _fit(points0[order], points1[order], model, options)
    except cv2.error:  # degenerate input, as all points in one place
        return nothing
    if matrix is None or matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return nothing
    if model == "homography":
        errors = transfer_errors(points0, points1, matrix)
    elif model == "fundamental":
        errors = epipolar_errors(points0, points1, matrix)
    else:
        inverse0, inverse1 = (np.linalg.inv(camera) for camera in _cameras(options))
        errors = epipolar_errors(points0, points1, inverse1.T @ matrix @ inverse0)
    return Geometry(model, matrix, errors < options.inlier_threshold)


def check_model(model: str, seed: int, options: GeometryOptions) -> None:
    """Raise an OptionError where `estimate_geometry` would, whatever the matches."""
    if model not in MODEL_NAMES:
        raise unknown_name("model", model, MODEL_NAMES)
    if not 0 <= seed < 2**31:
        raise OptionError(f"the seed must lie in [0, 2147483647], not {seed}")
    if model == "essential":
        _cameras(options)


def _fit(
    points0: np.ndarray, points1: np.ndarray, model: str, options: GeometryOptions
) -> np.ndarray | None:
    """Fit a model by OpenCV's estimator; None, or an odd matrix, where that fails."""
    method = cv2.USAC_MAGSAC if options.estimator == "magsac" else cv2.RANSAC
    threshold, confidence = options.inlier_threshold, options.confidence
    iterations = options.iterations
    if model == "homography":
        return cv2.findHomography(
            points0, points1, method, threshold, maxIters=iterations, confidence=confidence
        )[0]
    if model == "fundamental":
        return cv2.findFundamentalMat(points0, points1, method, threshold, confidence, iterations)[
            0
        ]
    # Both images in normalised coordinates; the threshold shrinks with the focal length.
    cameras = _cameras(options)
    first, second = (
        np.ascontiguousarray(
            (np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(camera).T)[:, :2]
        )
        for points, camera in zip((points0, points1), cameras, strict=True)
    )
    matrix, _ = cv2.findEssentialMat(
        first,
        second,
        np.eye(3),
        method=method,
        prob=confidence,
        threshold=threshold / ((cameras[0][0, 0] + cameras[1][0, 0]) / 2),
        maxIters=iterations,
    )
    return None if matrix is None else matrix[:3]


def _cameras(options: GeometryOptions) -> tuple[np.ndarray, np.ndarray]:
    if options.camera0 is None or options.camera1 is None:
        raise OptionError(
            "an essential matrix needs both cameras: give camera0 and camera1, "
            "or choose the fundamental matrix"
        )
    return options.camera0, options.camera1
