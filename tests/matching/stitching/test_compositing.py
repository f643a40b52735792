from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect import DeepDetectError, OptionError
from deepdetect._shared import machine
from deepdetect._shared.image_array import to_8_bits
from deepdetect.geometry.images import downscale
from deepdetect.matching.stitching.bundle_adjustment import RotatingCamera
from deepdetect.matching.stitching.canvas import (
    Canvas,
    least_distorted,
    plan_curved,
    plan_plane,
)
from deepdetect.matching.stitching.compositing import composite, crop_box

CAMERA = np.array([[400.0, 0, 199.5], [0, 400, 149.5], [0, 0, 1]])
SIZE = (400, 300)


def moved(x: float, y: float = 0) -> np.ndarray:
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])


def turned(degrees: float) -> np.ndarray:
    """To the frame of a camera that did not turn, from one that turned to the right."""
    rotation = cv2.Rodrigues(np.radians([0, degrees, 0]))[0]
    return CAMERA @ rotation @ np.linalg.inv(CAMERA)


def planned(homographies: dict[int, np.ndarray], reference: int = 0, scale: float = 1.0) -> Canvas:
    return plan_plane(dict.fromkeys(homographies, SIZE), homographies, reference, scale)[0]


def put_together(images: dict[int, np.ndarray], canvas: Canvas):
    small = {number: downscale(image, 200) for number, image in images.items()}
    return composite(lambda number: images[number], small, canvas)


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    data = pytest.importorskip("skimage.data")
    return np.ascontiguousarray(data.coffee())


def test_the_canvas_holds_all_corners() -> None:
    sizes, homographies = {0: SIZE, 3: SIZE}, {0: moved(0), 3: moved(-120.4, 60.2)}
    canvas, placed = plan_plane(sizes, homographies, 0, 1)
    assert canvas.size == (520, 360)
    assert canvas.boxes == {0: (120, 0, 520, 300), 3: (0, 60, 400, 360)}
    np.testing.assert_allclose(placed[0], moved(120))
    np.testing.assert_allclose(placed[3], moved(-0.4, 60.2))
    # In the frame of the other, and half as large, it is the same but for that.
    other, half = plan_plane(sizes, {0: moved(0), 3: moved(-120, 60)}, 3, 0.5)
    assert other.size == (260, 180)
    # The middle of two pixels is that of the half-size pixel which they become.
    np.testing.assert_allclose(half[3] @ [0.5, 0.5, 1], half[0] @ [-119.5, 60.5, 1])


@pytest.mark.parametrize("factor", [1, -2])
def test_what_reaches_the_horizon_is_refused(factor: int, one_line) -> None:
    # The corner of a camera with a field of view of 53 degrees.
    assert planned({0: np.eye(3), 1: factor * turned(40)}).size[0] > 1000
    for degrees in (60, 64, 90, 170):  # at 63 the corner is on the horizon; at 170 all is behind
        with pytest.raises(DeepDetectError, match=r"images\[1\] is seen too much") as error:
            planned({0: np.eye(3), 1: factor * turned(degrees)})
        one_line(error.value)


def test_a_canvas_too_large_is_refused(monkeypatch: pytest.MonkeyPatch, one_line) -> None:
    canvas = planned({0: np.eye(3), 1: moved(10_000)})
    with pytest.raises(OptionError, match=r"would be 10400x300 pixels, .*max_canvas_mega") as error:
        canvas.check_size(3.1)
    one_line(error.value)
    canvas.check_size(3.13)
    monkeypatch.setattr(machine, "available_memory", lambda: 10_400 * 300 * 22)
    with pytest.raises(OptionError, match="GB of memory, more than is free") as error:
        canvas.check_size(3.13)
    one_line(error.value)


def test_the_one_in_the_middle_is_least_stretched() -> None:
    angles = {4: -35, 1: 20, 7: 2, 2: 38}
    for frame in (0, 25):
        homographies = {number: turned(-frame) @ turned(a) for number, a in angles.items()}
        assert least_distorted(dict.fromkeys(angles, SIZE), homographies) == 7
    assert least_distorted({2: SIZE, 1: SIZE}, {2: moved(0), 1: moved(50)}) == 2


def test_an_image_is_drawn_where_it_belongs(scene: np.ndarray) -> None:
    canvas, _ = plan_plane({0: (600, 400), 1: SIZE}, {0: moved(40, 10), 1: moved(0)}, 1, 1)
    warped = canvas.draw(0, scene, 1, 1)
    assert warped.corner == (40, 10)
    np.testing.assert_array_equal(warped.image, scene)
    assert (warped.mask == 255).all()
    # Stripes of one pixel are grey when made smaller, not what sampling hits.
    stripes = np.zeros((200, 200, 3), np.uint8)
    stripes[:, ::2] = 255
    canvas, _ = plan_plane({0: (200, 200)}, {0: np.eye(3)}, 0, 0.25)
    small = canvas.draw(0, stripes, 1, 1).image
    assert np.abs(small[5:-5, 5:-5].astype(int) - 127.5).max() < 30


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


@pytest.mark.parametrize(
    ("projection", "height"),
    [
        ("cylindrical", lambda x, y, z: y / np.hypot(x, z)),
        ("spherical", lambda x, y, z: np.arctan2(y, np.hypot(x, z))),
    ],
)
def test_a_curved_canvas_shows_directions(projection, height) -> None:
    """Columns are angles about the axis, rows are heights or angles, of what each pixel shows."""
    cameras = {
        k: RotatingCamera(300.0 + 40 * k, cv2.Rodrigues(np.radians([5.0 * k, 40.0 * k, 3]))[0])
        for k in range(2)
    }
    canvas = plan_curved(projection, dict.fromkeys(cameras, SIZE), cameras, 0, 0.9)
    seen, true = [], []
    ramp = np.zeros((300, 400, 3), np.uint8)
    ramp[..., 0], ramp[..., 1] = np.arange(400) // 2, np.arange(300)[:, None] // 2
    for number, camera in cameras.items():
        drawn = canvas.draw(number, ramp, 1, 1)
        (left, top), shape = drawn.corner, drawn.mask.shape
        assert canvas.boxes[number] == (left, top, left + shape[1], top + shape[0])
        for row, column in np.argwhere(drawn.mask)[::3001]:
            x, y = 2 * drawn.image[row, column, :2].astype(float) + 0.5
            ray = camera.rotation @ np.linalg.inv(camera.intrinsics(SIZE)) @ [x, y, 1]
            seen.append([left + column, top + row])
            true.append(270 * np.array([np.arctan2(ray[0], ray[2]), height(*ray)]))
    offsets = np.array(seen) - true  # of the canvas, the same for all
    assert np.ptp(offsets, axis=0).max() < 4


def test_all_around_is_one_strip() -> None:
    """Twelve views of 45 degrees."""
    cameras = {
        k: RotatingCamera(480.0, cv2.Rodrigues(np.radians([0.0, 30 * k - 165, 0]))[0])
        for k in range(12)
    }
    canvas = plan_curved("cylindrical", dict.fromkeys(cameras, SIZE), cameras, 5, 0.5)
    assert canvas.size[0] == pytest.approx(2 * np.pi * 240, abs=3)
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
