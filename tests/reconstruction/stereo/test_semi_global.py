"""Whole disparities, beside a plain way and OpenCV's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect import OptionError
from deepdetect.reconstruction.stereo import semi_global as module
from deepdetect.reconstruction.stereo.census import matching_cost
from deepdetect.reconstruction.stereo.semi_global import SearchRange, semi_global


@pytest.fixture(scope="module")
def motorcycle() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    pytest.importorskip("skimage", reason="needs scikit-image for its stereo pair")
    from deepdetect.datasets.middlebury import load_motorcycle

    pair = load_motorcycle()
    part = slice(150, 310)
    left, right = (
        cv2.cvtColor(np.ascontiguousarray(view[part]), cv2.COLOR_RGB2GRAY)
        for view in (pair.left, pair.right)
    )
    return left, right, pair.disparity[part]


def test_the_paths_are_those_of_the_definition() -> None:
    """Sums over the eight paths, step by step, on a small volume."""
    generator = np.random.default_rng(0)
    gray = generator.integers(0, 256, (9, 14), np.uint8)
    left, right = (generator.integers(0, 2**62, gray.shape, np.uint64) for _ in range(2))
    total = module._volume(gray, left, right, -3, 16)
    height, width = gray.shape
    cost = matching_cost(left, right, -3, 16).astype(int)
    expected = np.zeros_like(cost)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        path = np.zeros_like(cost)
        for y in range(height)[:: dy or 1]:
            for x in range(width)[:: dx or 1]:
                before = (y - dy, x - dx)
                path[y, x] = cost[y, x]
                if not (0 <= before[0] < height and 0 <= before[1] < width):
                    continue
                change = abs(int(gray[y, x]) - int(gray[before]))
                large = int(max(100 / (1 + change / 8), 25) * 9 / 4)
                last = path[before]
                steps = np.pad(last, 1, constant_values=10**6)
                near = np.minimum(steps[:-2], steps[2:]) + 45
                path[y, x] += np.minimum.reduce([last, near, np.full(16, last.min() + large)])
                path[y, x] -= last.min()
        expected += path
    np.testing.assert_array_equal(total, expected)


def test_it_is_at_least_as_right_as_opencv(motorcycle) -> None:
    left, right, truth = motorcycle
    found = semi_global(left, right, SearchRange(0, 63))
    other = cv2.StereoSGBM_create(
        0, 64, 5, 600, 2400, uniquenessRatio=10, speckleWindowSize=100, speckleRange=2
    )
    theirs = other.compute(left, right) / 16
    shares = [
        np.mean(np.abs(disparity - truth)[known & np.isfinite(truth)] <= 1)
        for disparity, known in ((found.disparity, found.known), (theirs, theirs >= 0))
    ]
    assert shares[0] > shares[1] - 0.01
    assert found.known.mean() > 0.75
    both = found.known & (theirs >= 0)
    assert np.median(np.abs(found.disparity - theirs)[both]) < 0.2


def test_bands_give_nearly_what_the_whole_gives(
    motorcycle, monkeypatch: pytest.MonkeyPatch
) -> None:
    left, right, _ = motorcycle
    whole = semi_global(left, right, SearchRange(0, 63))
    monkeypatch.setattr(module, "VOLUME_BYTES", 3 * left.shape[1] * 64 * 100)
    bands = semi_global(left, right, SearchRange(0, 63))
    both = whole.known & bands.known
    assert both.mean() > 0.97 * whole.known.mean()
    assert np.mean(np.abs(whole.disparity - bands.disparity)[both] > 1) < 0.01
    assert not np.array_equal(whole.unique, bands.unique)  # there were bands


def test_disparities_stay_in_their_range() -> None:
    generator = np.random.default_rng(0)
    left, right = (generator.integers(0, 256, (30, 50), np.uint8) for _ in range(2))
    for search in (SearchRange(-7, 4), SearchRange(3, 3), SearchRange(-49, 49)):
        found = semi_global(left, right, search)
        inside = found.disparity[found.known]
        assert ((inside >= search.smallest) & (inside <= search.largest)).all()
        _, column = np.nonzero(found.known)
        there = column - np.rint(inside)
        assert ((there >= 0) & (there < 50)).all()
        assert (found.unique[found.known] >= 0).all()


def test_an_empty_range_is_refused() -> None:
    with pytest.raises(OptionError, match="exchange"):
        SearchRange(3, 2)
