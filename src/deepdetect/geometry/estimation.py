"""Robust estimation of the geometry between two images, and its number of false alarms (NFA).

The NFA of a geometry is the expected number of models that have at least as many inliers, at the
same threshold, if all matches are random (Moisan and Stival, "A probabilistic criterion to detect
rigid point matches between two images and estimate the fundamental matrix", 2004).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from math import inf, lgamma, log, pi
from numbers import Integral
from typing import Any, Protocol, runtime_checkable

import numpy as np

from .._shared.errors import OptionError, check_name
from .._shared.opencv import cv2
from .._shared.options import check_ranges, numbers_of, suggest_keywords
from .transforms import epipolar_errors, transfer_errors, transform_points

MODEL_NAMES = ("auto", "homography", "fundamental", "essential")

MIN_MATCHES = {"homography": 4, "fundamental": 15, "essential": 6}
"""Minimum number of matches for each model. It is 15 for a fundamental matrix, because OpenCV
ignores the inlier threshold if there are fewer."""

MAX_LOG10_NFA = -6.0
"""A geometry is trusted if log10 of its number of false alarms is below this. Chosen by hand."""

NEARBY_AREA = 16.0
"""A match is near a model if it lies in the inlier region enlarged to this multiple of its area. In
157 pairs of images of two sensors, `log10_nfa_nearby` reduced wrong answers from 16 to 2."""

MAX_ORDERS = 100
"""A fit tries at most this number of random orders of the matches until OpenCV raises no error. For
the worst of 1,600 sets of 15 to 25 nearby matches, OpenCV 5.0 raised one in 89 of 100 orders."""

MINIMAL_SAMPLE_SIZE = {"homography": 4, "fundamental": 7, "essential": 5}
"""Number of matches that the minimal solver of each model needs."""

MIN_PARALLAX_PX, MAX_EPIPOLE_DISTANCE_PX = 3.0, 1.5
"""A match is off the plane if its transfer error is at least MIN_PARALLAX_PX. It agrees with an
epipole if it is within MAX_EPIPOLE_DISTANCE_PX of the line from the epipole to the position that
the homography predicts. Chosen on Oxford, Middlebury, Strecha's fountain and a KITTI clip."""

MIN_FRACTION_OF_PLANE, MIN_FRACTION_OF_REST = 0.2, 0.5
"""A scene has depth if the number of matches that agree with one epipole is at least
MIN_FRACTION_OF_PLANE times that on the plane (moved objects give fewer), and MIN_FRACTION_OF_REST
times that off the plane. Chosen like `MIN_PARALLAX_PX`."""

MAX_MATCHES, SAMPLES = 2000, 1000
"""`measure_parallax` draws at most MAX_MATCHES matches off the plane, and SAMPLES epipoles, each
the intersection of the displacement lines of two of these matches. Chosen by hand."""


@suggest_keywords
@dataclass(frozen=True, eq=False)
class GeometryOptions:
    """How a geometry is estimated.

    Attributes:
        inlier_threshold: a match is an inlier if its error is below this, in pixels. The error is
            the transfer error of a homography, or the Sampson distance of other models.
        homography: a known (3, 3) homography. It is then not estimated, and the inliers are the
            matches with a transfer error below the threshold.
        camera0, camera1: (3, 3) camera matrices, for the model "essential".
        confidence: RANSAC stops when, with this probability, a sample was free of outliers.
        iterations: maximum number of samples that RANSAC draws.

    Raises:
        OptionError: a value is unknown, missing or out of its range.
    """

    inlier_threshold: float = 1.0
    homography: np.ndarray | None = field(default=None, repr=False)
    camera0: np.ndarray | None = field(default=None, repr=False)
    camera1: np.ndarray | None = field(default=None, repr=False)
    confidence: float = 0.999
    iterations: int = 10_000

    def __post_init__(self) -> None:
        if not 0 < self.confidence < 1:
            raise OptionError(f"the confidence must lie between 0 and 1, not {self.confidence}")
        check_ranges(self, positive=("inlier_threshold",), counts=("iterations",))
        for name in ("homography", "camera0", "camera1"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _matrix(name, getattr(self, name)))


def _matrix(name: str, value: Any) -> np.ndarray:
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise OptionError(f"{name} must be a (3, 3) matrix of finite numbers")
    if name != "homography" and (np.linalg.matrix_rank(matrix) < 3 or matrix[0, 0] <= 0):
        raise OptionError(
            f"{name} is not a camera matrix: it must be invertible and have a focal length above 0"
        )
    return matrix


@dataclass(frozen=True, eq=False, repr=False)
class Geometry:
    """An estimated geometry.

    Attributes:
        model: "homography", "fundamental" or "essential".
        matrix: (3, 3) float64, or None if the estimation failed. A homography maps the first image
            to the second. For the other models, x1^T matrix x0 = 0 for a match of x0 and x1, in
            pixels or, for an essential matrix, in normalised coordinates (rays).
        inliers: (M,) bool, True for the matches that agree with the matrix.
    """

    model: str
    matrix: np.ndarray | None
    inliers: np.ndarray

    def __repr__(self) -> str:
        inliers = np.count_nonzero(self.inliers)
        return f"Geometry(model={self.model!r}, {inliers} inliers of {len(self.inliers)} matches)"


@runtime_checkable
class MatchedPoints(Protocol):
    """Anything with (M, 2) matched positions in two images, such as `Matches`."""

    @property
    def points0(self) -> np.ndarray:
        """The (M, 2) positions in the first image."""

    @property
    def points1(self) -> np.ndarray:
        """The (M, 2) positions in the second image."""


@suggest_keywords
def estimate_geometry(
    matches: MatchedPoints | np.ndarray,
    points1: np.ndarray | None = None,
    model: str = "fundamental",
    *,
    seed: int = 0,
    options: GeometryOptions = GeometryOptions(),
) -> Geometry:
    """Estimate the geometry between two images from matches, some of which are wrong.

    Args:
        matches: `Matches`, or (M, 2) positions in the first image, where the centre of the first
            pixel is (0, 0).
        points1: (M, 2) matching positions in the second image; None if `matches` has them.
        model: "homography" (planes, pure rotation), "fundamental" (any static scene), "auto" (the
            one of these two that the parallax of the matches suggests), or "essential" (any static
            scene, known cameras).
        seed: seed of the random samples.
        options: inlier threshold, camera matrices, and limits of the estimation.

    Returns:
        The geometry; its inliers are the matches with an error below the threshold. If there are
        too few matches or the estimation fails, the matrix is None and there are no inliers.

    Raises:
        OptionError: the model is unknown or needs cameras that are not in the options, or the
            numbers of positions differ.

    Example:
        >>> a = np.array([[0, 0], [9, 0], [9, 9], [0, 9], [4, 5]], float)
        >>> geometry = estimate_geometry(a, a + 3, "homography")
        >>> geometry
        Geometry(model='homography', 5 inliers of 5 matches)
        >>> geometry.matrix[:2, 2].round(3).tolist()
        [3.0, 3.0]
    """
    check_model(model, seed, options)
    points0: Any = matches
    if isinstance(matches, MatchedPoints):
        if points1 is not None:
            raise OptionError("`points1` is for positions: leave it out if you give `Matches`")
        points0, points1 = matches.points0, matches.points1
    elif points1 is None:
        raise OptionError("positions in one image are not matches: give `points1`, or `Matches`")
    points0 = numbers_of("points0", points0, np.float64, 2)
    points1 = numbers_of("points1", points1, np.float64, 2)
    if len(points0) != len(points1):
        counts = f"{len(points0)} and {len(points1)}"
        raise OptionError(f"matches need equally many positions in both images, not {counts}")
    if options.homography is not None:
        errors = transfer_errors(points0, points1, options.homography)
        return Geometry("homography", options.homography, errors < options.inlier_threshold)
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
    matrix = fit_shuffled(partial(_fit, model=model, options=options), points0, points1, seed)
    if matrix is None:
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
    """Raise an OptionError if the model, the seed or the options for it are not valid."""
    check_name("model", model, MODEL_NAMES)
    check_seed(seed)
    if model == "essential":
        _cameras(options)


def check_seed(seed: int) -> None:
    """Raise an OptionError for a seed that OpenCV does not accept."""
    if not (isinstance(seed, Integral) and 0 <= seed < 2**31):
        raise OptionError(f"the seed must be a whole number from 0 to 2147483647, not {seed}")


def fit_shuffled(
    fit: Callable[[np.ndarray, np.ndarray], np.ndarray | None],
    points0: np.ndarray,
    points1: np.ndarray,
    seed: int,
) -> np.ndarray | None:
    """Fit a (3, 3) matrix to (M, 2) matches in a random order; return None if that fails.

    OpenCV always draws the same samples; a random order makes them depend on the seed. If MAGSAC
    raises an error, as it does for a few samples of ordinary matches, `fit` gets another order.
    Degenerate matches, such as coinciding points, raise no error, but give no (3, 3) matrix.
    """
    random = np.random.default_rng(seed)
    for _ in range(MAX_ORDERS):
        order = random.permutation(len(points0))
        try:
            matrix = fit(points0[order], points1[order])
        except cv2.error:
            continue
        usable = matrix is not None and matrix.shape == (3, 3) and np.isfinite(matrix).all()
        return matrix if usable else None
    return None


def _fit(
    points0: np.ndarray, points1: np.ndarray, model: str, options: GeometryOptions
) -> np.ndarray | None:
    """Fit a model by MAGSAC. If that fails, the result is None or a matrix of a wrong shape."""
    threshold, confidence = options.inlier_threshold, options.confidence
    iterations = int(options.iterations)
    sought = points0, points1, cv2.USAC_MAGSAC, threshold
    if model == "homography":
        return cv2.findHomography(*sought, maxIters=iterations, confidence=confidence)[0]
    if model == "fundamental":
        return cv2.findFundamentalMat(*sought, confidence, iterations)[0]
    cameras = _cameras(options)
    rays0, rays1 = (
        np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(camera).T
        for points, camera in zip((points0, points1), cameras, strict=True)
    )
    focal_px = (cameras[0][0, 0] + cameras[1][0, 0]) / 2
    return fit_essential(rays0, rays1, focal_px, threshold, confidence, iterations)


def fit_essential(
    rays0: np.ndarray,
    rays1: np.ndarray,
    focal_px: float,
    threshold_px: float,
    confidence: float,
    iterations: int,
) -> np.ndarray | None:
    """Fit an essential matrix by MAGSAC to (N, 3) rays (x, y, 1), with failures as in `_fit`.

    OpenCV gets the rays as pixels of a camera with the focal length `focal_px`, because its MAGSAC
    (in OpenCV 5) is less accurate in normalised coordinates.
    """
    matrix, _ = cv2.findEssentialMat(
        np.ascontiguousarray(rays0[:, :2] * focal_px),
        np.ascontiguousarray(rays1[:, :2] * focal_px),
        np.diag([focal_px, focal_px, 1.0]),
        method=cv2.USAC_MAGSAC,
        prob=confidence,
        threshold=threshold_px,
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


def log10_nfa(
    inliers: np.ndarray, model: str, inlier_threshold: float, image_size: tuple[int, int]
) -> float:
    """Return the decimal logarithm of the number of false alarms (NFA) of a model.

    `inliers` is (M,) bool: the matches with an error below `inlier_threshold`, in pixels.
    `image_size` is (width, height) of the second image. The result is infinite if there are too few
    inliers.
    """
    width, height = image_size
    if model == "homography":
        chance = pi * inlier_threshold**2 / (width * height)
    else:  # area of a band along an epipolar line, relative to that of the image
        chance = 2 * inlier_threshold * float(np.hypot(width, height)) / (width * height)
    agreeing = int(np.count_nonzero(inliers))
    return _log10_nfa(len(inliers), agreeing, MINIMAL_SAMPLE_SIZE[model], chance)


def log10_nfa_nearby(errors: np.ndarray, model: str, inlier_threshold: float) -> float:
    """Return the log10 NFA of a model among the matches near it, of which (M,) errors are given.

    Matches that are wrong by a few pixels, as on vague shapes in images of two sensors, lie near
    the true geometry. So more of them agree with some distorted geometry than if they ended
    anywhere. Random matches here are spread evenly over `NEARBY_AREA` times the inlier region.
    """
    reach = NEARBY_AREA**0.5 if model == "homography" else NEARBY_AREA
    count, agreeing = (
        int(np.count_nonzero(errors < limit))
        for limit in (reach * inlier_threshold, inlier_threshold)
    )
    return _log10_nfa(count, agreeing, MINIMAL_SAMPLE_SIZE[model], 1 / NEARBY_AREA)


def _log10_nfa(count: int, agreeing: int, sample_size: int, chance: float) -> float:
    def log_binomial(count: int, chosen: int) -> float:
        return lgamma(count + 1) - lgamma(chosen + 1) - lgamma(count - chosen + 1)

    if agreeing <= sample_size:
        return inf
    tests = log(count - sample_size)
    tests += log_binomial(count, agreeing) + log_binomial(agreeing, sample_size)
    return (tests + (agreeing - sample_size) * log(min(chance, 1.0))) / log(10)


@dataclass(frozen=True, eq=False)
class Parallax:
    """How many matches lie off a plane, and how many of them agree on an epipole.

    A correct match of a static scene that lies off the plane of a homography is displaced from the
    predicted position along a line through the epipole (Chum, Werner and Matas, "Two-view
    geometry estimation unaffected by a dominant plane", 2005). Wrong matches are displaced in any
    direction, except for a few in one direction on a repeated pattern. `log10_nfa` is the log10 of
    the number of false alarms of the agreement on the epipole.
    """

    on_plane: int
    off_plane: int
    agreeing: int
    log10_nfa: float

    def exceeds(self, fraction_of_plane: float) -> bool:
        """Whether chance does not explain `agreeing`, and it is >= this fraction of `on_plane`."""
        return self.log10_nfa < MAX_LOG10_NFA and self.agreeing >= fraction_of_plane * self.on_plane

    @property
    def shows_depth(self) -> bool:
        """Whether the matches off the plane alone show that the scene has depth."""
        most = self.agreeing >= MIN_FRACTION_OF_REST * self.off_plane
        return most and self.exceeds(MIN_FRACTION_OF_PLANE)


@dataclass(frozen=True, eq=False)
class TwoViewModel(Geometry):
    """A geometry, and the evidence for it. The model is "none" if the estimation failed.

    Attributes:
        log10_nfa: decimal logarithm of the number of false alarms of the geometry.
        parallax: parallax of the matches relative to the plane of the homography, or None if it
            was not measured.
    """

    log10_nfa: float
    parallax: Parallax | None = None

    @property
    def trusted(self) -> bool:
        """Whether the geometry has more inliers than chance explains."""
        return self.log10_nfa < MAX_LOG10_NFA


def measure_parallax(
    points0: np.ndarray, points1: np.ndarray, homography: np.ndarray, seed: int = 0
) -> Parallax:
    """Find the epipole on which most (M, 2) matches off the homography's plane agree."""
    points0, points1 = (np.asarray(points, np.float64) for points in (points0, points1))
    off = transfer_errors(points0, points1, homography) >= MIN_PARALLAX_PX
    on_plane = len(off) - int(np.count_nonzero(off))
    predicted, actual = transform_points(points0[off], homography), points1[off]
    finite = np.isfinite(predicted).all(axis=1)
    predicted, actual = predicted[finite], actual[finite]
    off_plane = len(actual)
    nothing = Parallax(on_plane, off_plane, 0, inf)
    if off_plane < 3:
        return nothing
    random = np.random.default_rng(seed)
    if off_plane > MAX_MATCHES:
        drawn = random.choice(off_plane, MAX_MATCHES, replace=False)
        predicted, actual = predicted[drawn], actual[drawn]
    low, size = points1.min(axis=0), np.ptp(points1, axis=0)
    if not size.all():  # all positions lie on one row or in one column
        return nothing
    scale = float(size.max())
    first, second = (
        np.column_stack([(points - low) / scale - 0.5, np.ones(len(points))])
        for points in (predicted, actual)
    )
    lines = np.cross(first, second)
    chosen = random.integers(0, len(lines), (SAMPLES, 2))
    epipoles = np.cross(lines[chosen[:, 0]], lines[chosen[:, 1]])
    length = np.linalg.norm(epipoles, axis=1)
    epipoles = epipoles[length > 1e-12] / length[length > 1e-12, None]
    if not len(epipoles):
        return nothing
    near = _misses(epipoles, first, second) < MAX_EPIPOLE_DISTANCE_PX / scale
    agreeing = int(np.count_nonzero(near, axis=1).max())
    band = 2 * MAX_EPIPOLE_DISTANCE_PX * float(np.hypot(*size)) / max(float(size.prod()), 1)
    alarms = _log10_nfa(len(actual), agreeing, 2, band)
    return Parallax(on_plane, off_plane, round(agreeing * off_plane / len(actual)), alarms)


def _misses(epipoles: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the (E, N) distances of `second` from the lines through epipoles and `first`."""
    x, y, scale = epipoles.T[:, :, None]
    normal = np.hypot(y - scale * first[:, 1], scale * first[:, 0] - x)
    return np.abs(epipoles @ np.cross(first, second).T) / np.maximum(normal, 1e-12)
