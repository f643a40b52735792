from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect import ImageError
from deepdetect.features.keypoints import Keypoints
from deepdetect.features.scale_space import nearest_layers
from deepdetect.features.sift import (
    DESCRIPTORS,
    dense_sift,
    describe_keypoints,
    opencv_sift_descriptors,
    root_sift_descriptors,
    scaled_sift_descriptors,
    sift_descriptors,
)
from deepdetect.io.image import luma


def make_gray(seed: int = 0, width: int = 90, height: int = 70) -> np.ndarray:
    """A smooth random image: neighbouring pixels are similar, as in a photograph."""
    noise = np.random.default_rng(seed).integers(0, 256, (height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def make_points(
    seed: int = 1, count: int = 40, width: int = 90, height: int = 70, margin: int = 0
) -> np.ndarray:
    rng = np.random.default_rng(seed)
    x = rng.integers(margin, width - margin, count)
    y = rng.integers(margin, height - margin, count)
    return np.stack([x, y], 1).astype(np.float32)


def opencv_sift(gray: np.ndarray, xy: np.ndarray, size: float, angle: float) -> np.ndarray:
    """One keypoint at a time, each made by hand: no order can be lost."""
    rows = []
    for x, y in xy:
        keypoint = cv2.KeyPoint(float(x), float(y), size, angle, 0.0, 0)
        rows.append(cv2.SIFT_create().compute(gray, [keypoint])[1][0])
    return np.array(rows)


@pytest.mark.parametrize(
    ("size", "angle"),
    [(3.0, 0.0), (3.0, -1.0), (3.0, 90.0), (4.5, 0.0), (4.5, 359.0), (12.0, 45.0), (0.5, 0.0)],
)
def test_sift_equals_opencv_with_handmade_keypoints(size: float, angle: float) -> None:
    gray, xy = make_gray(), make_points()
    expected = opencv_sift(gray, xy, size, angle)
    np.testing.assert_array_equal(sift_descriptors(gray, xy, size, angle), expected)


def test_the_unset_angle_is_a_turn_of_one_degree() -> None:
    gray, xy = make_gray(), make_points()
    unset = sift_descriptors(gray, xy, angle=-1).astype(int)
    upright = sift_descriptors(gray, xy, angle=0).astype(int)
    assert not np.array_equal(unset, upright)
    # -1 and 359 are the same direction, up to the rounding of cosine and sine.
    turned = sift_descriptors(gray, xy, angle=359)
    assert np.abs(unset - turned).max() <= 1
    # One degree is little: far nearer to upright than a quarter turn is.
    near = np.linalg.norm(unset - upright, axis=1)
    far = np.linalg.norm(sift_descriptors(gray, xy, angle=90) - upright, axis=1)
    assert near.max() < 100
    assert (near < far).all()


@pytest.mark.parametrize("describe", [sift_descriptors, root_sift_descriptors])
@pytest.mark.parametrize("shift", [(1, 0), (0, 1), (7, 4), (13, 9)])
def test_a_shifted_image_has_the_same_descriptors_at_shifted_points(describe, shift) -> None:
    dx, dy = shift
    whole = make_gray(width=140, height=120)
    xy = make_points(width=100, height=90, margin=25)
    here = describe(np.ascontiguousarray(whole[dy : dy + 90, dx : dx + 100]), xy)
    np.testing.assert_array_equal(describe(whole, xy + np.float32([dx, dy])), here)


def test_pixel_centres_are_whole_numbers() -> None:
    """Turned by half, the pixel (x, y) of an image is (W - 1 - x, H - 1 - y).

    A convention with the centre of the first pixel at (0.5, 0.5) would be off by one.
    """
    gray = make_gray()
    height, width = gray.shape
    xy = make_points(margin=20)
    turned = np.ascontiguousarray(gray[::-1, ::-1])
    upright = sift_descriptors(gray, xy).astype(int)
    right = sift_descriptors(turned, np.float32([width - 1, height - 1]) - xy, angle=180)
    wrong = sift_descriptors(turned, np.float32([width, height]) - xy, angle=180)
    assert np.abs(upright - right).max() <= 2
    assert np.linalg.norm(upright - wrong, axis=1).mean() > 20


def test_at_their_own_scale_sifts_keypoints_have_sifts_descriptors(photo: np.ndarray) -> None:
    gray = luma(photo)
    sift = cv2.SIFT_create(contrastThreshold=0.01, enable_precise_upscale=True)
    found, expected = sift.detectAndCompute(gray, None)
    points = Keypoints.from_opencv(found, gray.shape[::-1])
    assert len(set((points.octaves & 255).tolist())) >= 3
    described = scaled_sift_descriptors(gray, points.xy, points.sizes, points.angles)
    np.testing.assert_array_equal(described, expected)


def test_at_their_own_scale_any_sizes_are_described_in_order() -> None:
    gray = make_gray()
    xy = make_points(count=60)
    rng = np.random.default_rng(2)
    sizes, angles = rng.uniform(0.5, 200, 60), rng.uniform(0, 360, 60)
    found = scaled_sift_descriptors(gray, xy, sizes, angles)
    order = rng.permutation(60)
    again = scaled_sift_descriptors(gray, xy[order], sizes[order], angles[order])
    assert (found.shape, found.dtype) == ((60, 128), np.uint8)
    octave = nearest_layers(sizes, gray.shape)[0]
    assert octave.min() == nearest_layers(sizes[order], gray.shape)[0].min()
    np.testing.assert_array_equal(again, found[order])
    none = scaled_sift_descriptors(gray, xy[:0], sizes[:0], angles[:0])
    assert none.shape == (0, 128)


def test_root_sift_distances_are_hellinger_distances_of_sift() -> None:
    """|sqrt(p) - sqrt(q)|^2 = 2 - 2 * sum(sqrt(p * q)) for distributions p and q."""
    gray, xy = make_gray(), make_points()
    sift = sift_descriptors(gray, xy).astype(np.float64)
    distribution = sift / sift.sum(1, keepdims=True)
    affinity = np.sqrt(distribution[:, None] * distribution[None]).sum(2)
    root = root_sift_descriptors(gray, xy) / 512
    squared = ((root[:, None] - root[None]) ** 2).sum(2)
    np.testing.assert_allclose(squared, 2 - 2 * affinity, atol=0.01)


def test_many_keypoints_are_done_at_once_and_few_by_opencv() -> None:
    gray = make_gray()
    everywhere = np.stack(np.meshgrid(np.arange(90), np.arange(70)), -1).reshape(-1, 2)
    np.testing.assert_array_equal(sift_descriptors(gray, everywhere), dense_sift(gray, everywhere))
    expected = opencv_sift_descriptors(gray, everywhere).astype(int)
    assert np.abs(sift_descriptors(gray, everywhere) - expected).max() <= 1
    for xy, angle in ((everywhere, 30.0), (everywhere + 0.25, 0.0), (everywhere[:9], 0.0)):
        np.testing.assert_array_equal(
            sift_descriptors(gray, xy, 3.0, angle), opencv_sift_descriptors(gray, xy, 3.0, angle)
        )
    np.testing.assert_array_equal(
        sift_descriptors(gray, everywhere, 9.0), opencv_sift_descriptors(gray, everywhere, 9.0)
    )


@pytest.mark.parametrize("name", DESCRIPTORS)
@pytest.mark.parametrize("count", [0, 1, 5])
def test_every_descriptor_keeps_the_contract(name: str, count: int) -> None:
    rng = np.random.default_rng(0)
    gray = rng.integers(0, 256, (40, 50)).astype(np.uint8)
    xy = rng.integers(0, 40, (count, 2)).astype(np.float32)
    before = gray.copy(), xy.copy()
    descriptors = DESCRIPTORS[name](gray, xy, 3.0, 0.0)
    assert descriptors.dtype == np.uint8
    assert descriptors.ndim == 2
    assert len(descriptors) == count
    np.testing.assert_array_equal(gray, before[0])
    np.testing.assert_array_equal(xy, before[1])


def test_only_the_keypoints_own_image_describes_them() -> None:
    gray = make_gray()
    for sizes in (None, np.full(40, 9.0)):
        points = Keypoints(make_points(), np.ones(40), (90, 70), sizes=sizes)
        assert describe_keypoints(gray, points).descriptors.shape == (40, 128)
        for other in (
            np.ascontiguousarray(gray[:, :-1]),
            np.ascontiguousarray(gray.T),
            np.dstack([gray] * 3),
            gray.astype(np.float32),
            gray.astype(np.uint16),
        ):
            with pytest.raises(ImageError):
                describe_keypoints(other, points)
