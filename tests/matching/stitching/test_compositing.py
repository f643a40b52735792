from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect._shared.image_array import to_8_bits
from deepdetect.geometry.images import downscale
from deepdetect.matching.stitching.bundle_adjustment import RotatingCamera
from deepdetect.matching.stitching.canvas import (
    Canvas,
    plan_curved,
    plan_plane,
)
from deepdetect.matching.stitching.compositing import composite, crop_box

SIZE = (400, 300)


def moved(x: float, y: float = 0) -> np.ndarray:
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])


def planned(homographies: dict[int, np.ndarray], reference: int = 0, scale: float = 1.0) -> Canvas:
    return plan_plane(dict.fromkeys(homographies, SIZE), homographies, reference, scale, "0123")[0]


def put_together(images: dict[int, np.ndarray], canvas: Canvas):
    small = {number: downscale(image, 200) for number, image in images.items()}
    return composite(lambda number: images[number], small, canvas)


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    data = pytest.importorskip("skimage.data")
    return np.ascontiguousarray(data.coffee())


def test_parts_become_the_whole(scene: np.ndarray) -> None:
    images = {0: scene[:300, :400], 1: scene[:300, 150:550], 2: scene[90:390, 60:460]}
    canvas = planned({0: moved(0), 1: moved(150), 2: moved(60, 90)})
    assert canvas.size == (550, 390)
    panorama, valid, gains, _ = put_together(images, canvas)
    assert max(abs(gain - 1) for gain in gains.values()) < 1e-3
    expected = np.zeros((390, 550), bool)
    expected[:300] = True
    expected[90:, 60:460] = True
    np.testing.assert_array_equal(valid, expected)
    differences = np.abs(panorama.astype(int) - scene[:390, :550])[valid]
    assert differences.mean() < 0.4
    assert np.quantile(differences, 0.999) < 10
    assert differences.max() < 50
    assert not panorama[~valid].any()


def test_equal_images_are_kept_to_the_last_bit(scene: np.ndarray) -> None:
    images = {0: scene[:300, :400], 1: scene[:300, :400]}
    panorama, valid, *_ = put_together(images, planned({0: moved(0), 1: moved(0)}))
    np.testing.assert_array_equal(panorama, scene[:300, :400])
    assert valid.all()


def test_more_than_8_bits_are_kept(scene: np.ndarray) -> None:
    noise = np.random.default_rng(0).integers(0, 257, scene.shape)
    deep = (scene * 256.0 + noise).astype(np.uint16)
    images = {0: deep[:300, :400], 1: deep[:300, 150:550]}
    canvas = planned({0: moved(0), 1: moved(150)})
    small = {number: (to_8_bits(image), 1.0) for number, image in images.items()}
    panorama, valid, *_ = composite(lambda number: images[number], small, canvas)
    assert panorama.dtype == np.uint16
    assert valid.all()
    differences = np.abs(panorama.astype(int) - deep[:300, :550])
    assert np.median(differences) < 257 / 4
    mixed, *_ = composite(lambda n: small[n][0] if n else images[n], small, canvas)
    assert np.abs(mixed.astype(int) - deep[:300, :550]).mean() < 257


def test_brightness_becomes_equal(scene: np.ndarray) -> None:
    scene = scene // 2
    dark = (scene[:300, 150:550] * 0.7).astype(np.uint8)
    canvas = planned({0: moved(0), 1: moved(150)})
    panorama, _, gains, _ = put_together({0: scene[:300, :400], 1: dark}, canvas)
    assert gains[1] / gains[0] == pytest.approx(1 / 0.7, rel=0.03)
    factor = panorama.astype(float).mean((0, 2)) / scene[:300, :550].mean((0, 2))
    assert factor[:150].mean() / factor[-150:].mean() == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize(("focal_px", "scale"), [(480.0, 0.5), (343.0, 2.0)])
def test_all_around_is_one_strip(focal_px: float, scale: float) -> None:
    """Twelve views of 45 degrees, and of 60: some go on behind the end by two pixels only."""
    cameras = {
        k: RotatingCamera(focal_px, cv2.Rodrigues(np.radians([0.0, 30 * k - 165, 0]))[0])
        for k in range(12)
    }
    canvas = plan_curved("cylindrical", dict.fromkeys(cameras, SIZE), cameras, 5, scale)
    assert canvas.size[0] == pytest.approx(2 * np.pi * focal_px * scale, abs=3)
    plain = {k: np.full((300, 400, 3), 100, np.uint8) for k in cameras}
    panorama, valid, *_ = put_together(plain, canvas)
    assert (np.abs(panorama[valid].astype(int) - 100) < 3).all()
    assert valid[60:-60].all()


def test_the_largest_rectangle() -> None:
    generator = np.random.default_rng(0)
    for shape in ((7, 9), (12, 5), (1, 6)):
        valid = cv2.blur(generator.random(shape), (3, 3)) > 0.4
        sums = np.pad(valid, ((1, 0), (1, 0))).astype(int).cumsum(0).cumsum(1)
        areas = [
            (b - t) * (r - x)
            for t in range(shape[0])
            for b in range(t + 1, shape[0] + 1)
            for x in range(shape[1])
            for r in range(x + 1, shape[1] + 1)
            if sums[b, r] - sums[t, r] - sums[b, x] + sums[t, x] == (b - t) * (r - x)
        ]
        left, top, right, bottom = crop_box(valid)
        assert valid[top:bottom, left:right].all()
        assert (right - left) * (bottom - top) == max(areas, default=0)
