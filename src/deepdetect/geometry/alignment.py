"""Align patches of one image to another by Gauss-Newton, with a covariance for each.

The alignment is inverse compositional (Baker and Matthews, "Lucas-Kanade 20 years on", 2004), and
independent of the gain and offset of the brightness.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._shared.machine import parallel_for

MAX_ITERATIONS = 15
"""Maximum number of Gauss-Newton steps for a patch. Chosen by hand."""

MIN_CORRELATION = 0.8
"""A patch has converged only if its correlation is at least this. Chosen by hand."""

RIDGE = 1e-3
"""If affinities are also estimated, this multiple of the mean squared gradient is added to the
diagonal of the normal equations: a patch of parallel edges makes them singular. Chosen by hand."""


@dataclass(frozen=True)
class Alignment:
    """How patches are aligned.

    Attributes:
        radius_px: the side of a patch is 2 * radius + 1 pixels, and its pixels have Gaussian
            weights with a sigma of radius / 2.
        max_shift_px: maximum distance of a patch from its initial position.
        convergence_px: a patch has converged after a step shorter than this.
        affine: whether the affine map of a patch is estimated, and not only its position.
        cubic: whether values between pixels are interpolated by Keys's cubic; otherwise bilinearly,
            which takes half of the time and is as exact in blurred images.
    """

    radius_px: int
    max_shift_px: float
    convergence_px: float
    affine: bool = False
    cubic: bool = True


@dataclass(frozen=True, eq=False)
class Aligned:
    """Aligned patches: those that did not converge keep their position and affinity.

    Attributes:
        points1: (N, 2) float64 positions in the second image.
        correlations: (N,) float32 correlations of the patches; 0 if a patch did not converge.
        affinities: (N, 2, 2) float64 linear maps of the patches from the first image to the second.
        covariances: (N, 2, 2) float64 covariances of `points1` in square pixels, from the
            differences of the patches, as if the noise of their pixels were independent.
    """

    points1: np.ndarray
    correlations: np.ndarray
    affinities: np.ndarray
    covariances: np.ndarray

    @property
    def converged(self) -> np.ndarray:
        """(N,) bool, True for patches that converged."""
        return np.asarray(self.correlations > 0)


def align_patches(
    images: tuple[np.ndarray, np.ndarray],
    points0: np.ndarray,
    start: np.ndarray,
    affinities: np.ndarray,
    how: Alignment,
) -> Aligned:
    """Align patches of the first image, each warped by its affinity, to the second image.

    The images are (H, W) float32. `points0` are the centres of the patches, (N, 2), `start` their
    initial positions in the second image, (N, 2), and `affinities` is (N, 2, 2). A patch does not
    converge if it is flat, crosses the border, moves too far or correlates below `MIN_CORRELATION`.
    """
    from .alignment_kernel import align

    offsets = np.arange(-how.radius_px, how.radius_px + 1)
    squared = offsets[:, None] ** 2 + offsets**2
    window = np.exp(-2 * squared / how.radius_px**2).astype(np.float32)
    points0, start = (np.ascontiguousarray(each, np.float64) for each in (points0, start))
    affinities = np.array(affinities, np.float64, order="C")
    aligned, correlations = np.empty((len(start), 2)), np.empty(len(start), np.float32)
    parts = np.zeros((len(start), 3))
    given = *images, points0, start, affinities, window
    free = (6, RIDGE) if how.affine else (2, 0.0)
    limits = MAX_ITERATIONS, how.convergence_px, how.max_shift_px, np.float32(MIN_CORRELATION)
    parallel_for(len(start), align, *given, *free, how.cubic, *limits, aligned, correlations, parts)
    pixels = float(window.sum() ** 2 / (window**2).sum())
    covariances = parts[:, [0, 1, 1, 2]].reshape(-1, 2, 2) / pixels
    return Aligned(aligned, correlations, affinities, covariances)
