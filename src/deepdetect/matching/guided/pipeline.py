"""Guided matching: a geometry from few points, sharpened, then all keypoints where it points.

Geometry only proposes: a pair stays when both places look alike once the geometry is taken out
(`agreement_test`). The true geometry is never seen.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..._shared.errors import unknown_name
from ...features.matchers import DescriptorMatches
from ...features.matches import Guide
from ...geometry import GeometryOptions, estimate_geometry
from ...geometry.homography_refinement import (
    RefinementOptions,
    refine_homography,
    refine_homography_irls,
)
from ...geometry.rescaling import downscale, scaled_homography
from .epipolar import matches_by_epipolar_line
from .homography import matches_by_homography
from .initial_geometry import FirstPass, InitialMatches, first_pass
from .prewarp import affinity_between, straightened

MODELS = ("auto", "homography", "fundamental")

LONGEST = 1600
"""Longer sides are shrunk to so many pixels where the geometry is sharpened."""

SHARPENING = RefinementOptions(max_rounds=2, windows_px=(15, 21, 41), inlier_threshold=0.5)

ROUNDS = 2
LEAST_MORE = 0.01
"""New fundamental matrices from the dense matches, at the most, and the share of further matches
that one must give."""

FEWEST = 0.02
"""With fewer matches than this share of the keypoints, the geometry is not trusted after all."""


def guided_matches(
    gray0: np.ndarray,
    gray1: np.ndarray,
    xy0: np.ndarray,
    xy1: np.ndarray,
    model: str = "auto",
    seed: int = 0,
    initial: InitialMatches | None = None,
) -> tuple[Guide, DescriptorMatches | None]:
    """Match the keypoints of two images by their geometry.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        xy0, xy1: (N, 2), (M, 2) keypoints on whole pixels.
        model: "homography", "fundamental" or "auto".
        seed: of all random choices.
        initial: of `initial_matches`, where they are there already.

    Returns:
        What guided, and the matches; None when nothing could.

    Raises:
        OptionError: the model is unknown.
    """
    if model not in MODELS:
        raise unknown_name("model", model, MODELS)
    first = first_pass(gray0, gray1, model, seed, initial)
    if first.kind == "none" or first.matrix is None:
        return _guide(first, None), None
    if first.kind == "homography":
        matrix = sharpened(gray0, gray1, first.matrix)
        rows0, rows1, ratios = matches_by_homography(gray0, gray1, xy0, xy1, matrix, seed)
    else:
        matrix, (rows0, rows1, ratios) = _by_lines(gray0, gray1, xy0, xy1, first, seed)
    if len(rows0) < FEWEST * min(len(xy0), len(xy1)):
        return _guide(replace(first, kind="none", points0=first.points0[:0]), None), None
    return _guide(first, matrix), DescriptorMatches(rows0, rows1, ratios)


def _by_lines(
    gray0: np.ndarray,
    gray1: np.ndarray,
    xy0: np.ndarray,
    xy1: np.ndarray,
    first: FirstPass,
    seed: int,
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Match by a fundamental matrix; take a new one from the matches while that gives more.

    The second image is turned as the first one stands where it does not stand so already.
    """
    affinity = affinity_between(first.points0, first.points1)
    view = None if affinity is None else straightened(gray0, gray1, xy1, affinity)

    def matched(fundamental: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        if view is None:
            return matches_by_epipolar_line(gray0, gray1, xy0, xy1, fundamental, seed)
        rows0, rows1, ratios = matches_by_epipolar_line(
            view.gray0, view.gray1, xy0, view.xy1, view.fundamental(fundamental), seed
        )
        return rows0, view.rows1[rows1], ratios

    assert first.matrix is not None
    best = first.matrix, matched(first.matrix)
    for _ in range(ROUNDS):
        rows0, rows1, _ = best[1]
        options = GeometryOptions(model="fundamental", inlier_threshold=1.0, seed=seed)
        matrix = estimate_geometry(xy0[rows0], xy1[rows1], options).matrix
        if matrix is None:
            break
        found = matched(matrix)
        if len(found[0]) <= len(rows0) * (1 + LEAST_MORE):
            break
        best = matrix, found
    return best


def sharpened(gray0: np.ndarray, gray1: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """Refine a homography by the images, shrunk to what that needs; (3, 3)."""
    (small0, scale0), (small1, scale1) = (downscale(gray, LONGEST) for gray in (gray0, gray1))
    start = scaled_homography(homography, scale0, scale1)
    found = refine_homography(small0, small1, start, SHARPENING).homography
    found = refine_homography_irls(small0, small1, found)
    return scaled_homography(found, 1 / scale0, 1 / scale1)


def _guide(first: FirstPass, matrix: np.ndarray | None) -> Guide:
    return Guide(
        first.kind,
        matrix,
        first.matches,
        len(first.points0),
        float(first.log10_nfa),
        first.simulated,
    )
