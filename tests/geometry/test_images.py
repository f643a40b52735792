from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import shift as shifted

from deepdetect.geometry.images import (
    edge_strength,
    erode_mask,
    gaussian_blur,
    local_zncc,
    median_local_zncc,
    warp_to_reference,
    window_sums,
)


def noise(seed: int = 0, size: tuple[int, int] = (64, 80)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, size).astype(np.uint8)


def test_equals_numpys_correlation_of_a_window() -> None:
    first, second = noise(0), noise(1) // 2 + noise(0) // 2
    found = local_zncc(first, second, np.ones(first.shape, bool))
    windows = [image[20:35, 30:45].ravel() for image in (first, second)]
    assert found[27, 37] == pytest.approx(np.corrcoef(*windows)[0, 1], abs=1e-5)


def test_light_and_contrast_do_not_matter() -> None:
    first = noise() // 2
    found = local_zncc(first, first + 90, np.ones(first.shape, bool))
    assert np.nanmin(found) == pytest.approx(1, abs=1e-6)


def test_flat_windows_and_those_beyond_the_overlap_do_not_count() -> None:
    image = noise()
    image[:, :40] = 7
    valid = np.ones(image.shape, bool)
    valid[40:] = False
    found = local_zncc(image, image, valid)
    assert np.isnan(found[:, :32]).all()  # flat, seven pixels before the edge at 40
    assert np.isnan(found[33:]).all()
    assert np.isfinite(found[8:32, 48:70]).all()


def test_warping_back_undoes_a_shift_of_whole_pixels() -> None:
    image = noise()
    moved = shifted(image, (3, 5), order=0, cval=0)  # B(x + 5, y + 3) = A(x, y)
    homography = np.array([[1.0, 0, 5], [0, 1, 3], [0, 0, 1]])
    warped, seen = warp_to_reference(moved, homography, (80, 64))
    assert seen[: 64 - 3, : 80 - 5].all()
    assert not seen[64 - 3 :].any()
    assert not seen[:, 80 - 5 :].any()
    np.testing.assert_array_equal(warped[:61, :75], image[:61, :75])
    assert median_local_zncc(image, moved, homography) == pytest.approx(1, abs=1e-6)
    assert abs(median_local_zncc(image, moved, np.eye(3))) < 0.2


def test_what_lies_beyond_the_border_does_not_bleed_in() -> None:
    first, second = noise(), noise()
    second[:, 60:] = 255
    seen = np.ones(first.shape, bool)
    seen[:, 60:] = False
    inside = erode_mask(seen, 1.25)
    difference = np.abs(gaussian_blur(first, 1.25) - gaussian_blur(second, 1.25))
    assert inside[8:-8, 8:55].all()
    assert difference[inside].max() < 0.5
    assert difference[:, 57:60].max() > 5


@pytest.mark.parametrize("window", [1, 3, 9])
def test_sums_are_those_of_brute_force(window: int) -> None:
    generator = np.random.default_rng(0)
    rows, columns = np.nonzero(generator.random((20, 31)) < 0.4)
    pixels = np.column_stack([columns, rows])
    values = generator.normal(size=len(pixels))
    at = np.column_stack([generator.integers(0, 31, 50), generator.integers(0, 20, 50)])
    for places in (None, at):
        centres = pixels if places is None else places
        near = (np.abs(centres[:, None] - pixels) <= window // 2).all(2)
        found = window_sums(pixels, values, (20, 31), window, at=places)
        np.testing.assert_allclose(found, near @ values, atol=1e-9)


def test_edges_do_not_tell_which_side_is_bright() -> None:
    gray = noise()
    edges = edge_strength(gray)
    np.testing.assert_array_equal(edge_strength(255 - gray), edges)
    step = np.zeros((40, 40), np.uint8)
    step[:, 20:] = 90
    assert (edge_strength(step).argmax(1) // 2 == 19 // 2).all()
    assert not edge_strength(np.full((40, 40), 7, np.uint8)).any()
