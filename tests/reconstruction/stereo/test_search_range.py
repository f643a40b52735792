from __future__ import annotations

import numpy as np
import pytest

from deepdetect.reconstruction.stereo.search_range import find_search_range

SHAPE = (200, 480)
ROW, COLUMN = np.indices(SHAPE)


@pytest.mark.parametrize(
    "surface",
    [
        np.full(SHAPE, 0.0),
        np.full(SHAPE, -60.0),
        np.full(SHAPE, 150.0),
        10 + 0.1 * COLUMN,
        -20 + 0.2 * ROW,
    ],
    ids=["none", "negative", "large", "slanted", "both signs"],
)
def test_the_range_holds_the_disparities_and_not_much_more(surface, smooth_pair) -> None:
    found = find_search_range(*smooth_pair(surface))
    seen = surface[(surface <= COLUMN) & (COLUMN - surface < SHAPE[1])]
    low, high = np.quantile(seen, [0.01, 0.99])
    assert found.smallest <= low
    assert found.largest >= high
    assert found.count < 1.5 * (high - low) + 20


def test_a_few_wrong_patches_do_not_widen_it(smooth_pair) -> None:
    left, right = smooth_pair(np.full(SHAPE, 20.0))
    right = right.copy()
    right[10:30, 300:330] = left[10:30, 60:90]  # a patch of its own
    found = find_search_range(left, right)
    assert found.smallest <= 20 <= found.largest
    assert found.count < 30


def test_flat_views_have_none() -> None:
    flat = np.full((64, 64), 9, np.uint8)
    found = find_search_range(flat, flat)
    assert found is None or found.count < 64


@pytest.fixture(scope="module")
def smooth_pair(rectified_pair):
    """Pairs whose texture is still seen on the small copy."""
    import cv2

    def make(surface: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        small = surface[::4, ::4] / 4
        row, column = np.indices(SHAPE, np.float32)
        _, right = rectified_pair(small)
        right = cv2.resize(right, SHAPE[::-1], interpolation=cv2.INTER_CUBIC)
        there = (column - surface).astype(np.float32)
        left = cv2.remap(right, there, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        return left, right

    return make
