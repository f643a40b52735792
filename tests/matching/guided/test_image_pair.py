from __future__ import annotations

import numpy as np
import pytest

from deepdetect.matching.guided import ImagePair


@pytest.fixture
def pair() -> ImagePair:
    rng = np.random.default_rng(0)
    first, second = (rng.integers(0, 256, shape, np.uint8) for shape in ((60, 90), (80, 40)))
    return ImagePair((first, second), (first > 200, None))


def test_sizes_are_widths_and_heights(pair: ImagePair) -> None:
    assert pair.sizes == ((90, 60), (40, 80))


def test_each_reduced_copy_is_made_once(pair: ImagePair) -> None:
    small, scale = pair.reduced(0, 45)
    assert (small.shape, scale) == ((30, 45), 0.5)
    assert pair.reduced(0, 45)[0] is small
    assert pair.reduced(0, 30)[0] is not small
    (first, second), scales = pair.both(45)
    assert first is small
    assert max(second.shape) == 45
    assert scales == (0.5, pytest.approx(45 / 80, abs=0.01))


def test_an_image_is_never_enlarged(pair: ImagePair) -> None:
    whole, scale = pair.reduced(1, 500)
    np.testing.assert_array_equal(whole, pair.grays[1])
    assert scale == 1


def test_a_swapped_pair_has_the_same_copies_and_masks(pair: ImagePair) -> None:
    (first, second), scales = pair.both(45)
    other = pair.swapped()
    assert other.sizes == pair.sizes[::-1]
    assert other.masks[1] is pair.masks[0]
    assert other.masks[0] is None
    (one, two), swapped = other.both(45)
    assert one is second
    assert two is first
    assert swapped == scales[::-1]
    assert other.swapped().grays[0] is pair.grays[0]
