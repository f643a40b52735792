"""Fit a similarity robustly to points that are known in two frames, to georeference a model.

A least-median-of-squares search finds a similarity, and Gauss-Newton with Huber's weights refines
it by all points, and by directions that are known to be horizontal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._shared.errors import ReconstructionError
from .._shared.opencv import cv2
from .camera import cross_matrix

MIN_POINTS = 3
"""The fit fails if fewer points than this agree, because a similarity needs three points."""

MAX_SAMPLES = 500
"""The search tries this number of random triples of points and, if the upward direction is known,
the same number of pairs. Chosen by hand."""

MAX_START_TILT_DEG = 60.0
"""A similarity of three points may tilt the known upward direction away from the z axis by at most
this angle, because three points that lie nearly on a line can give any tilt."""

MIN_AREA_POINTS, MIN_AREA, MUCH_BETTER = 8, 0.2, 0.5
"""A known upward direction is ignored only if there are at least MIN_AREA_POINTS points, their
second principal axis is longer than MIN_AREA times the first, and the median residual without the
direction is below MUCH_BETTER times that with it. Chosen by hand."""

HUBER_STDS, WRONG_STDS = 2.0, 5.0
"""Residuals above HUBER_STDS sigmas get less weight, above WRONG_STDS none. Chosen by hand."""

PRIOR_COUNT = 6.0
"""The stated accuracy of the targets counts as much as this number of residuals, because a few
residuals say little about the true accuracy. Chosen by hand."""

MAD_STD = 1.4826
"""Ratio of the standard deviation of a normal distribution to its median absolute deviation."""

MAX_ITERATIONS, MIN_STEP = 50, 1e-9


@dataclass(frozen=True, eq=False)
class Similarity:
    """A similarity of 3D points: y = scale * rotation @ x + translation."""

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Transform (N, 3) points, to (N, 3) float64."""
        return np.asarray(self.scale * (points @ self.rotation.T) + self.translation)


@dataclass(frozen=True, eq=False)
class SimilarityFit:
    """A similarity, and how reliable it is.

    Attributes:
        similarity: similarity that maps the points to the targets.
        residuals: (N, 3) targets minus transformed points, NaN where the target is unknown.
        wrong: (N,) bool, True for points that do not agree with the others.
        scale_std: relative standard deviation of the scale; 0 if the scale was given.
        axes_std_deg: (3,) standard deviations of the rotation about the targets' axes, in degrees.
        axis_std_deg_of_targets: largest standard deviation about an axis, without `level`, degrees.
    """

    similarity: Similarity
    residuals: np.ndarray
    wrong: np.ndarray
    scale_std: float
    axes_std_deg: np.ndarray
    axis_std_deg_of_targets: float


def fit_similarity(
    points: np.ndarray,
    targets: np.ndarray,
    accuracy: float,
    *,
    up: np.ndarray | None = None,
    level: np.ndarray = np.empty((0, 3)),
    level_stds: np.ndarray = np.empty(0),
    scale: float | None = None,
) -> SimilarityFit:
    """Fit the similarity from points to targets on which most of the points agree.

    Args:
        points: (N, 3) positions of at least three points.
        targets: (N, 3) positions of the same points, z up; z may be NaN where it is unknown.
        accuracy: expected standard deviation of the targets, in their unit of length.
        up: (3,) approximate upward direction in the frame of the points.
        level, level_stds: (L, 3) horizontal directions in the frame of the points, and their (L,)
            standard deviations in radians.
        scale: the scale, if it is known.

    Raises:
        ReconstructionError: the points coincide, or too few of them agree.
    """
    points, targets = (np.asarray(values, np.float64) for values in (points, targets))
    targets = targets.copy()
    known = np.isfinite(targets)
    targets[~known] = 0.0
    found = _search(points, targets, known, up, scale)
    if found is None:
        raise ReconstructionError("the points are in one place")
    middle = points.mean(axis=0)  # turning and scaling about this point leave it in place
    own, free = points - middle, 7 if scale is None else 6
    current = Similarity(found.scale, found.rotation, found.apply(middle[None])[0])
    distances = np.linalg.norm((targets - current.apply(own)) * known, axis=1)
    stds = np.full(3, max(MAD_STD * float(np.median(distances)), accuracy))
    for _ in range(MAX_ITERATIONS):
        residuals = (targets - current.apply(own)) * known
        away = np.linalg.norm(residuals / stds, axis=1)
        wrong = away > WRONG_STDS
        if (~wrong).sum() < MIN_POINTS:
            raise ReconstructionError("too few of the points agree")
        stds = _spread(residuals[~wrong], known[~wrong], accuracy)
        weights = np.where(wrong, 0, np.minimum(1, HUBER_STDS / np.maximum(away, 1e-12)))
        turned = current.scale * (own @ current.rotation.T)
        jacobian = changes(turned) * (known / stds)[:, :, None]
        weighted = jacobian * weights[:, None, None]
        of_targets = np.einsum("nai,naj->ij", weighted, jacobian)
        right = np.einsum("nai,na->i", weighted, residuals / stds)
        # Horizontal directions should have z = 0; tilted images make z larger and get less weight.
        seen = level @ current.rotation.T
        errors = seen[:, 2] / level_stds
        rows = np.zeros((len(level), 7))
        rows[:, 3], rows[:, 4] = seen[:, 1] / level_stds, -seen[:, 0] / level_stds
        trust = 1 / (1 + (errors / HUBER_STDS) ** 2)
        normal = of_targets + (rows * trust[:, None]).T @ rows
        right -= (rows * trust[:, None]).T @ errors
        step = np.zeros(7)
        step[:free] = np.linalg.lstsq(normal[:free, :free], right[:free], rcond=1e-12)[0]
        current = Similarity(
            current.scale * float(np.exp(np.clip(step[6], -1, 1))),
            cv2.Rodrigues(step[3:6])[0] @ current.rotation,
            current.translation + step[:3],
        )
        if np.abs(step / np.array([*stds, 1, 1, 1, 1])).max() < MIN_STEP:
            break
    covariance, alone = (_covariance(matrix[:free, :free]) for matrix in (normal, of_targets))
    deviations = np.sqrt(np.diag(covariance))
    widest = float(np.sqrt(np.linalg.eigvalsh(alone[3:6, 3:6])[-1]))
    shift = current.translation - current.scale * (current.rotation @ middle)
    return SimilarityFit(
        Similarity(current.scale, current.rotation, shift),
        np.where(known, targets - current.apply(own), np.nan),
        wrong,
        0.0 if scale is not None else float(deviations[6]),
        np.degrees(deviations[3:6]).clip(max=180),
        min(float(np.degrees(widest)), 180.0),
    )


def changes(points: np.ndarray) -> np.ndarray:
    """Return the (N, 3, 7) derivatives of (N, 3) points by translation, rotation and log scale."""
    moves = np.tile(np.eye(3), (len(points), 1, 1))
    turns = np.reshape([-cross_matrix(row) for row in points], (-1, 3, 3))
    return np.concatenate([moves, turns, points[:, :, None]], axis=2)


def _search(
    points: np.ndarray,
    targets: np.ndarray,
    known: np.ndarray,
    up: np.ndarray | None,
    scale: float | None,
) -> Similarity | None:
    """Find the similarity of 3 random points, or of 2 and `up`, with the least median distance."""
    random = np.random.default_rng(0)
    best: dict[bool, tuple[float, Similarity | None]] = dict.fromkeys((True, False), (np.inf, None))
    for size in [3] * MAX_SAMPLES + [2] * (0 if up is None else MAX_SAMPLES):
        rows = random.choice(len(points), size, replace=False)
        axis = up if size == 2 else None
        found = least_squares_similarity(points[rows], targets[rows], axis, scale)
        if found is None:
            continue
        median = float(np.median(np.linalg.norm((targets - found.apply(points)) * known, axis=1)))
        upright = up is None or (found.rotation @ up)[2] > np.cos(np.radians(MAX_START_TILT_DEG))
        if median < best[bool(upright)][0]:
            best[bool(upright)] = median, found
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    sure = len(points) >= MIN_AREA_POINTS and spread[1] > MIN_AREA * spread[0]
    # If all cameras look straight down, the assumed upward direction may be far off.
    return best[not (sure and best[False][0] < MUCH_BETTER * best[True][0])][1]


def least_squares_similarity(
    points: np.ndarray,
    targets: np.ndarray,
    up: np.ndarray | None = None,
    scale: float | None = None,
) -> Similarity | None:
    """Fit a similarity by least squares (Umeyama, 1991); return None if all points coincide.

    If `up` is given, it is mapped to the z axis, and only the rotation about this axis is fitted.
    """
    middle, middle_of_targets = points.mean(axis=0), targets.mean(axis=0)
    own, other = points - middle, targets - middle_of_targets
    if up is not None:
        across = np.linalg.svd(np.asarray(up)[None])[2][1:]  # any two axes across `up`
        upright = np.array([across[0], np.cross(up, across[0]), up])
        own = own @ upright.T
        own[:, 2] = other[:, 2] = 0
        cosine, sine = float((own * other).sum()), float(np.cross(own, other)[:, 2].sum())
        strength = float(np.hypot(sine, cosine))
        rotation = cv2.Rodrigues(np.array([0, 0, np.arctan2(sine, cosine)]))[0] @ upright
    else:
        left, values, right = np.linalg.svd(other.T @ own)
        signs = np.array([1, 1, np.sign(np.linalg.det(left @ right)) or 1])
        rotation = left @ np.diag(signs) @ right
        strength = float(values @ signs)
    factor = scale if scale is not None else strength / float((own**2).sum() or np.inf)
    if not factor > 0:
        return None
    return Similarity(factor, rotation, middle_of_targets - factor * (rotation @ middle))


def _spread(residuals: np.ndarray, known: np.ndarray, accuracy: float) -> np.ndarray:
    """Return the (3,) standard deviations of the targets; those of x and y are the same."""
    stds = []
    for axes, lost in (([0, 1], 5), ([2], 2)):  # `lost`: parameters fitted to these axes
        values = np.abs(residuals[:, axes][known[:, axes]])
        squares = len(values) * (MAD_STD * np.median(values)) ** 2 if len(values) else 0.0
        free = PRIOR_COUNT + max(len(values) - lost, 0)
        stds += len(axes) * [np.sqrt((PRIOR_COUNT * accuracy**2 + squares) / free)]
    return np.array(stds)


def _covariance(normal: np.ndarray) -> np.ndarray:
    """Invert a normal matrix; parameters that it does not determine get large variances."""
    values, vectors = np.linalg.eigh(normal)
    return np.asarray(vectors / np.maximum(values, 1e-12 * values[-1]) @ vectors.T)
