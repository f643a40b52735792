"""Plane and parallax: whether the matches of a scene show depth.

What a homography leaves of the matches of a static scene moves along lines through one point, the
epipole. Chum, Werner and Matas, "Two-view geometry estimation unaffected by a dominant plane",
2005. Wrong matches move anywhere, and those of a repeated pattern in one direction, but they are
few beside what lies on the plane; whether more matches agree on an epipole than chance explains is
decided a contrario (`acontrario`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .acontrario import MAX_LOG10_NFA, log_binomial
from .residuals import transfer_errors, transform_points

MIN_PARALLAX_PX = 3.0
"""Matches whose transfer error is at least this are off the plane."""

MAX_EPIPOLE_DISTANCE_PX = 1.5
"""By which one of them may miss the line through the epipole."""

MIN_FRACTION_OF_PLANE = 0.2
"""As many of them must agree, relative to the matches on the plane, to show depth: a repeated
pattern, or a thing that moved, gives few."""

MIN_FRACTION_OF_REST = 0.5
"""This fraction of all matches off the plane must agree, where the matches alone decide."""

MAX_MATCHES = 2000
"""Off the plane; of more, so many are drawn at random."""

SAMPLES = 1000
"""Pairs of matches whose lines are intersected."""


@dataclass(frozen=True, eq=False)
class Parallax:
    """The matches off a plane, and how many of them agree on an epipole.

    Attributes:
        on_plane: number of matches that the homography explains.
        off_plane: number of those that it does not.
        agreeing: number of the latter that move along lines through the epipole.
        epipole: (3,) homogeneous, in the second image; None without any.
        log10_nfa: decimal logarithm of the number of false alarms of that agreement.
    """

    on_plane: int
    off_plane: int
    agreeing: int
    epipole: np.ndarray | None
    log10_nfa: float

    def exceeds(self, fraction_of_plane: float) -> bool:
        """Whether more agree than chance explains, and as many relative to those on the plane."""
        significant = self.log10_nfa < MAX_LOG10_NFA
        return significant and self.agreeing >= fraction_of_plane * self.on_plane

    @property
    def shows_depth(self) -> bool:
        """Whether these matches alone show that the scene has depth."""
        most = self.agreeing >= MIN_FRACTION_OF_REST * self.off_plane
        return most and self.exceeds(MIN_FRACTION_OF_PLANE)


@dataclass(frozen=True, eq=False)
class TwoViewModel:
    """The model of a pair, and the evidence for it.

    Attributes:
        model: "homography", "fundamental", or "none" where nothing could be estimated.
        matrix: (3, 3) float64, or None.
        inliers: (M,) bool, the matches that agree with it.
        log10_nfa: decimal logarithm of its number of false alarms.
        parallax: of a homography that was chosen, not asked for: what it leaves.
    """

    model: str
    matrix: np.ndarray | None
    inliers: np.ndarray
    log10_nfa: float
    parallax: Parallax | None = None

    @property
    def trusted(self) -> bool:
        """Whether chance does not explain it."""
        return self.log10_nfa < MAX_LOG10_NFA


def measure_parallax(
    points0: np.ndarray,
    points1: np.ndarray,
    homography: np.ndarray,
    seed: int = 0,
) -> Parallax:
    """Look for an epipole among the matches that a homography leaves.

    Args:
        points0, points1: (M, 2) matches, some of them wrong.
        homography: (3, 3) from the first image to the second.
        seed: of the random pairs of matches.

    Example:
        >>> points = np.random.default_rng(0).uniform(0, 500, (300, 2))
        >>> depth = np.repeat([0, 1.0], 150) * np.linspace(8, 40, 300)  # half of it before a wall
        >>> moved = points + np.column_stack([depth, np.zeros(300)])
        >>> measure_parallax(points, moved, np.eye(3)).shows_depth
        True
        >>> wrong = np.random.default_rng(1).uniform(0, 500, (150, 2))
        >>> moved = np.concatenate([points[:150], wrong])
        >>> measure_parallax(points, moved, np.eye(3)).shows_depth
        False
    """
    points0, points1 = (np.asarray(points, np.float64) for points in (points0, points1))
    off = transfer_errors(points0, points1, homography) >= MIN_PARALLAX_PX
    on_plane = len(off) - int(np.count_nonzero(off))
    predicted, found = transform_points(points0[off], homography), points1[off]
    finite = np.isfinite(predicted).all(axis=1)
    predicted, found = predicted[finite], found[finite]
    off_plane = len(found)
    nothing = Parallax(on_plane, off_plane, 0, None, math.inf)
    if off_plane < 3:
        return nothing
    random = np.random.default_rng(seed)
    if off_plane > MAX_MATCHES:
        drawn = random.choice(off_plane, MAX_MATCHES, replace=False)
        predicted, found = predicted[drawn], found[drawn]
    low, size = points1.min(axis=0), np.ptp(points1, axis=0)
    if not size.all():  # all on one row or column
        return nothing
    scale = float(size.max())
    first, second = (
        np.column_stack([(points - low) / scale - 0.5, np.ones(len(points))])
        for points in (predicted, found)
    )
    lines = np.cross(first, second)
    chosen = random.integers(0, len(lines), (SAMPLES, 2))
    epipoles = np.cross(lines[chosen[:, 0]], lines[chosen[:, 1]])
    length = np.linalg.norm(epipoles, axis=1)
    epipoles = epipoles[length > 1e-12] / length[length > 1e-12, None]
    if not len(epipoles):
        return nothing
    limit = MAX_EPIPOLE_DISTANCE_PX / scale
    counts = np.count_nonzero(_misses(epipoles, first, second) < limit, axis=1)
    best = int(np.argmax(counts))
    to_pixels = np.array(
        [[scale, 0, low[0] + scale / 2], [0, scale, low[1] + scale / 2], [0, 0, 1]]
    )
    band = 2 * MAX_EPIPOLE_DISTANCE_PX * float(np.hypot(*size)) / max(float(size.prod()), 1)
    agreeing = int(counts[best])
    return Parallax(
        on_plane,
        off_plane,
        round(agreeing * off_plane / len(found)),
        to_pixels @ epipoles[best],
        _log10_nfa(len(found), agreeing, band),
    )


def _misses(epipoles: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the distances of points from the lines through epipoles and predictions, (E, N)."""
    x, y, scale = epipoles.T[:, :, None]
    normal = np.hypot(y - scale * first[:, 1], scale * first[:, 0] - x)
    return np.abs(epipoles @ np.cross(first, second).T) / np.maximum(normal, 1e-12)


def _log10_nfa(count: int, agreeing: int, chance: float) -> float:
    """Return the logarithm of the number of false alarms of an epipole, which two matches give."""
    if agreeing <= 2:
        return math.inf
    tests = math.log(count - 2) + log_binomial(count, agreeing) + log_binomial(agreeing, 2)
    return (tests + (agreeing - 2) * math.log(min(chance, 1.0))) / math.log(10)
