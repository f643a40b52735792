"""The determinant of the Hessian beside derivatives of the Gaussian and plain searches."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from deepdetect_lab.evaluation.baselines.external import find_feature
from deepdetect_lab.evaluation.baselines.hessian import (
    HESSIAN,
    detect_hessian,
    detect_hessian_scales,
    hessian_response,
)


def textured(height: int = 60, width: int = 80, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(size=(height, width))
    smooth = ndimage.gaussian_filter(noise, 1.5)
    return np.uint8(255 * (smooth - smooth.min()) / np.ptp(smooth))


def blob(x: float, y: float, sigma: float, size: int = 65) -> np.ndarray:
    row, column = np.indices((size, size))
    return np.exp(-((column - x) ** 2 + (row - y) ** 2) / (2 * sigma**2)).astype(np.float32)


@pytest.mark.parametrize("sigma", [1.5, 3.0, 6.0])
def test_the_response_is_that_of_derivatives_of_the_gaussian(sigma: float) -> None:
    gray = textured()
    yy, xx, xy = (
        ndimage.gaussian_filter(gray / 255, sigma, order, truncate=6)
        for order in ((2, 0), (0, 2), (1, 1))
    )
    expected = np.abs(xx * yy - xy**2) * sigma**4
    inner = (slice(20, -20), slice(20, -20))
    found = hessian_response(gray, sigma)[inner]
    # Differences of neighbours are not quite derivatives where sigma is small.
    assert np.corrcoef(found.ravel(), expected[inner].ravel())[0, 1] > 0.995
    assert found.max() == pytest.approx(expected[inner].max(), rel=0.8 / sigma**2)


def test_points_are_the_maxima_of_their_windows() -> None:
    gray = textured()
    response = hessian_response(gray, 3.0)
    highest = ndimage.maximum_filter(response, 5, mode="constant", cval=-1)
    expected = {(x, y) for y, x in np.argwhere((response == highest) & (response > 0))}
    found = detect_hessian(gray)
    assert {tuple(point) for point in np.rint(found.xy).astype(int).tolist()} == expected


@pytest.mark.parametrize(("x", "y"), [(32.0, 30.0), (31.3, 32.4)])
def test_a_blob_is_found_between_pixels(x: float, y: float) -> None:
    found = detect_hessian(blob(x, y, 4)).best(1)
    np.testing.assert_allclose(found.xy[0], (x, y), atol=0.05)


def test_the_scale_is_the_blobs() -> None:
    found = detect_hessian_scales(blob(32, 32, 5.0)).best(1)
    # |det H| sigma^4 of a Gaussian blob is largest where sigma is its own.
    assert 4.0 < found.sizes[0] / 5 < 6.2
    np.testing.assert_allclose(found.xy[0], (32, 32), atol=0.05)


def test_scales_together_keep_their_distance_and_the_best() -> None:
    gray = textured(seed=1)
    found = detect_hessian_scales(gray)
    gaps = np.linalg.norm(found.xy[:, None] - found.xy[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    assert gaps.min() >= 2
    strongest = max(hessian_response(gray, sigma).max() for sigma in np.geomspace(1.5, 9.1, 7))
    assert found.scores.max() == pytest.approx(strongest, rel=1e-5)


@pytest.mark.parametrize("name", HESSIAN)
def test_they_are_found_by_name_and_bear_flat_and_small_images(name: str) -> None:
    feature = find_feature(name)
    assert feature is HESSIAN[name]
    for shape in ((40, 30, 3), (5, 4, 3)):
        image = np.full(shape, 127, np.uint8)
        found = feature.detect(image)
        assert found.image_size == (shape[1], shape[0])
        assert feature.describe(image, found).shape == (len(found), 128)
