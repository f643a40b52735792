"""Matches of synthetic views, whose true positions are known."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
import skimage.data

from deepdetect import (
    Keypoints,
    Matches,
    PointDetector,
    match_features,
    match_images,
    refine_matches,
)
from deepdetect._shared.errors import ImageError
from deepdetect.features.matches import TwoViewGeometry
from deepdetect.geometry import transform_points

STILL_PX2, PIXEL_PX2 = 0.99, 0.35**2
"""Smaller than the variance of a match of points that cannot be aligned; that of pixels."""


def view(gray: np.ndarray, homography: np.ndarray, blur_px: float, noise: float) -> np.ndarray:
    size = gray.shape[::-1]
    warped = cv2.warpPerspective(
        gray.astype(np.float32), homography, size, flags=cv2.INTER_LANCZOS4
    )
    if blur_px:
        warped = cv2.GaussianBlur(warped, (0, 0), blur_px)
    warped = 0.8 * warped + 20 + np.random.default_rng(0).normal(0, noise, gray.shape)
    return np.clip(np.rint(warped), 0, 255).astype(np.uint8)


def camera() -> np.ndarray:
    return cv2.GaussianBlur(skimage.data.camera()[:400, 60:500], (0, 0), 0.7)


def turned(degrees: float, zoom: float) -> np.ndarray:
    return np.vstack([cv2.getRotationMatrix2D((220.3, 199.6), degrees, zoom), [0, 0, 1]])


@pytest.mark.parametrize(
    ("homography", "blur_px"),
    [
        (turned(0, 1) @ np.array([[1, 0, 0.4], [0, 1, -0.3], [0, 0, 1]]), 0.0),
        (turned(0, 1), 2.0),
        (turned(20, 1.3), 0.0),
        (turned(-15, 0.8), 1.0),
    ],
)
@pytest.mark.parametrize("swapped", [False, True])
def test_matches_are_exact_to_a_tenth_of_a_pixel(
    homography: np.ndarray, blur_px: float, swapped: bool
) -> None:
    first = camera()
    images = [first, view(first, homography, blur_px, 2)]
    if swapped:
        images, homography = images[::-1], np.linalg.inv(homography)
    detector = PointDetector(500)
    matches = match_features(*(detector.extract(image) for image in images))
    true = transform_points(matches.points0, homography)
    before = np.linalg.norm(matches.points1 - true, axis=1)
    matches, true, before = matches[before < 3], true[before < 3], before[before < 3]
    refined = refine_matches(*images, matches)
    off = refined.points1 - true
    assert refined.covariances is not None
    exact = refined.covariances[:, 0, 0] < STILL_PX2
    assert exact.mean() > 0.8
    assert np.median(np.linalg.norm(off[exact], axis=1)) < 0.12
    assert np.median(np.linalg.norm(off, axis=1)) < 0.6 * np.median(before)
    inverse = np.linalg.inv(refined.covariances[exact])
    normalised = np.sqrt(np.einsum("ni,nij,nj->n", off[exact], inverse, off[exact]))
    assert 0.3 < np.median(normalised) < 1.6  # 1.18 by the normal distribution
    assert (refined.points0 == matches.points0).all()


def positions(points0: np.ndarray, points1: np.ndarray, **fields: Any) -> Matches:
    """Return matches of keypoints that have neither sizes nor angles."""
    size, rows = (440, 400), np.arange(len(points0))
    ends = (Keypoints(points, np.ones(len(rows)), size) for points in (points0, points1))
    scores, inliers = np.ones(len(rows)), np.ones(len(rows), bool)
    return Matches(points0, points1, scores, inliers, *ends, indices0=rows, indices1=rows, **fields)


def test_a_homography_gives_the_first_affinities() -> None:
    """A view that is turned by half a circle: patches that are not turned match nowhere."""
    first, homography = camera(), turned(180, 1)
    second = view(first, homography, 0, 1)
    points0 = np.float32(np.argwhere(np.ones((9, 10))) * 40 + 30)[:, ::-1]
    points1 = transform_points(points0, homography) + (0.4, -0.3)
    known = TwoViewGeometry("homography", homography, "planar")
    lost, found = (
        refine_matches(first, second, positions(points0, points1, **fields)).covariances
        for fields in ({}, {"geometry": known})
    )
    assert lost is not None
    assert found is not None
    assert (lost[:, 0, 0] < 0.9 * PIXEL_PX2).mean() < 0.1
    assert (found[:, 0, 0] < 0.9 * PIXEL_PX2).mean() > 0.5


def test_matches_that_cannot_be_aligned_keep_their_positions() -> None:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (2, 400, 440)).astype(np.uint8)
    points = np.float32([[50, 60], [200, 100], [1, 2], [438, 399]])
    refined = refine_matches(*images, positions(points, points[::-1]))
    assert (refined.points1 == points[::-1]).all()
    assert refined.covariances is not None
    np.testing.assert_allclose(refined.covariances, [PIXEL_PX2 * np.eye(2)] * 4, rtol=1e-6)
    assert refined[:1].covariances is not None
    assert refined.swapped().covariances is None


def test_no_matches_have_no_covariances() -> None:
    nothing = np.empty((0, 2))
    refined = refine_matches(camera(), camera(), positions(nothing, nothing))
    assert refined.covariances is not None
    assert refined.covariances.shape == (0, 2, 2)


def test_an_image_of_another_size_is_refused() -> None:
    points = np.float32([[50, 60]])
    with pytest.raises(ImageError, match="image1"):
        refine_matches(camera(), camera()[:300], positions(points, points))


def test_guided_matches_of_whole_pixels_become_more_exact() -> None:
    """Where a patch shows only an edge, the position along it stays as it was."""
    first, homography = camera(), turned(5, 1.1)
    second = view(first, homography, 0, 2)
    matches = match_images(first, second)[::5]
    refined = refine_matches(first, second, matches)
    true = transform_points(matches.points0, homography)
    before, after = (np.linalg.norm(each.points1 - true, axis=1) for each in (matches, refined))
    assert np.mean(after < 0.5) > np.mean(before < 0.5) + 0.1
    assert np.mean(after < 1) > np.mean(before < 1) - 0.02


def test_subpixel_matches_of_a_rectified_pair_stay_as_they_are() -> None:
    points = np.float32([[50, 60]])
    matches = positions(points, points, subpixel=True)
    assert refine_matches(camera(), camera(), matches) is matches
