"""Robust fitting of a similarity between points in two frames, which georeferences a model.

Least median of squares finds a similarity on which most points agree. Gauss-Newton with Huber's
weights then refines it by all points, and by directions that are known to be horizontal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._shared.errors import ReconstructionError
from .._shared.opencv import cv2
from .camera import cross_matrix

MIN_POINTS = 3
"""Minimum number of points that must agree: they determine a similarity."""

MAX_SAMPLES = 500
"""Number of pairs, and of triples, of points that the search tries. Chosen by hand."""

MAX_START_TILT_DEG = 60.0
"""The similarity of three points may tilt the known upward direction by at most this angle. Three
points near a line may give any tilt."""

MIN_AREA_POINTS, MIN_AREA = 8, 0.2
"""The points can overrule the known upward direction only if there are at least as many as the
first, and their second principal spread exceeds the first one times the second. Chosen by hand."""

MUCH_BETTER = 0.5
"""The known upward direction is overruled if the median distance without it is below this fraction
of the median distance with it. Chosen by hand."""

HUBER_STDS = 2.0
"""Residuals above this many standard deviations get less weight. Chosen by hand."""

WRONG_STDS = 5.0
"""A point with a residual above this many standard deviations gets no weight. Chosen by hand."""

PRIOR_COUNT = 6.0
"""The stated accuracy counts as this many residuals: few residuals say little. Chosen by hand."""

MAD_STD = 1.4826
"""Standard deviation of a normal distribution, divided by the median of absolute values."""

MAX_ITERATIONS, MIN_STEP = 50, 1e-9


@dataclass(frozen=True, eq=False)
class Similarity:
    """y = scale * rotation @ x + translation."""

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Transform (N, 3) points."""
        return np.asarray(self.scale * (points @ self.rotation.T) + self.translation)


@dataclass(frozen=True, eq=False)
class SimilarityFit:
    """A similarity, and how reliable it is.

    Attributes:
        similarity: from the points to the targets.
        residuals: (N, 3) target minus transformed point.
        wrong: (N,) bool, points that do not agree with the others.
        scale_std: relative standard deviation of the scale; 0 if it was given.
        axes_std_deg: (3,) standard deviations of the rotation about the x, y and z axis.
        axis_std_deg_of_targets: that about the least certain axis, from the targets alone; 180 if
            they do not determine it.
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
    seed: int = 0,
) -> SimilarityFit:
    """Fit the similarity on which most of the points agree.

    Args:
        points: (N, 3), three or more.
        targets: (N, 3) target positions, z up; z may be NaN where it is unknown.
        accuracy: standard deviation of the targets, as far as it is known beforehand.
        up: (3,) approximate upward direction in the frame of the points.
        level, level_stds: (L, 3) directions in this frame that are horizontal, and (L,) their
            standard deviations in radians.
        scale: the scale, if it is known.
        seed: seed of the random choices.

    Raises:
        ReconstructionError: the points coincide, or too few of them agree.
    """
    points, targets = (np.asarray(values, np.float64) for values in (points, targets))
    targets = targets.copy()
    known = np.isfinite(targets)
    targets[~known] = 0.0
    found = _search(points, targets, known, up, scale, seed)
    if found is None:
        raise ReconstructionError("the points are in one place")
    middle = points.mean(axis=0)  # rotation and scale about it do not change the translation
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
        jacobian = np.zeros((len(points), 3, 7))
        jacobian[:, :, :3] = np.eye(3)
        jacobian[:, :, 3:6] = [-cross_matrix(row) for row in turned]
        jacobian[:, :, 6] = turned
        jacobian *= (known / stds)[:, :, None]
        weighted = jacobian * weights[:, None, None]
        of_targets = np.einsum("nai,naj->ij", weighted, jacobian)
        right = np.einsum("nai,na->i", weighted, residuals / stds)
        # e_z . exp(w) R v = 0, robust like the points: some photographs are tilted.
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


def _search(
    points: np.ndarray,
    targets: np.ndarray,
    known: np.ndarray,
    up: np.ndarray | None,
    scale: float | None,
    seed: int,
) -> Similarity | None:
    """Find the similarity of three points, or two and `up`, with the least median distance."""
    random = np.random.default_rng(seed)
    best: dict[bool, tuple[float, Similarity | None]] = dict.fromkeys((True, False), (np.inf, None))
    for size in [3] * MAX_SAMPLES + [2] * (0 if up is None else MAX_SAMPLES):
        rows = random.choice(len(points), size, replace=False)
        found = least_squares_similarity(
            points[rows], targets[rows], up if size == 2 else None, scale
        )
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
    """Fit a similarity by least squares (Umeyama, 1991). None if all points coincide.

    With `up`, this direction is mapped to the z axis, and only the rotation about it is fitted.
    """
    middle, middle_of_targets = points.mean(axis=0), targets.mean(axis=0)
    own, other = points - middle, targets - middle_of_targets
    if up is not None:
        across = np.linalg.svd(np.asarray(up)[None])[2][1:]  # any two axes
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
    """Return the (3,) standard deviations of the targets, the same for x and y."""
    stds = []
    for axes, lost in (([0, 1], 5), ([2], 2)):  # `lost`: number of fitted parameters
        values = np.abs(residuals[:, axes][known[:, axes]])
        squares = len(values) * (MAD_STD * np.median(values)) ** 2 if len(values) else 0.0
        free = PRIOR_COUNT + max(len(values) - lost, 0)
        stds += len(axes) * [np.sqrt((PRIOR_COUNT * accuracy**2 + squares) / free)]
    return np.array(stds)


def _covariance(normal: np.ndarray) -> np.ndarray:
    """Invert a normal matrix, with large variances for parameters that it does not determine."""
    values, vectors = np.linalg.eigh(normal)
    return np.asarray(vectors / np.maximum(values, 1e-12 * values[-1]) @ vectors.T)
