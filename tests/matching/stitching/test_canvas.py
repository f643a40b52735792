from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect import Camera, DeepDetectError, OptionError
from deepdetect._shared import machine
from deepdetect.matching.stitching.bundle_adjustment import RotatingCamera
from deepdetect.matching.stitching.canvas import (
    Canvas,
    least_distorted,
    plan_curved,
    plan_plane,
)

CAMERA = np.array([[400.0, 0, 199.5], [0, 400, 149.5], [0, 0, 1]])
SIZE = (400, 300)


def moved(x: float, y: float = 0) -> np.ndarray:
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])


def turned(degrees: float) -> np.ndarray:
    """To the frame of a camera that did not turn, from one that turned to the right."""
    rotation = cv2.Rodrigues(np.radians([0, degrees, 0]))[0]
    return CAMERA @ rotation @ np.linalg.inv(CAMERA)


def planned(homographies: dict[int, np.ndarray], reference: int = 0, scale: float = 1.0) -> Canvas:
    return plan_plane(dict.fromkeys(homographies, SIZE), homographies, reference, scale, "0123")[0]


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    data = pytest.importorskip("skimage.data")
    return np.ascontiguousarray(data.coffee())


def test_the_canvas_holds_all_corners() -> None:
    sizes, homographies = {0: SIZE, 3: SIZE}, {0: moved(0), 3: moved(-120.4, 60.2)}
    canvas, placed = plan_plane(sizes, homographies, 0, 1, "0123")
    assert canvas.size == (520, 360)
    assert canvas.boxes == {0: (120, 0, 520, 300), 3: (0, 60, 400, 360)}
    np.testing.assert_allclose(placed[0], moved(120))
    np.testing.assert_allclose(placed[3], moved(-0.4, 60.2))
    # In the frame of the other, and half as large, it is the same but for that.
    other, half = plan_plane(sizes, {0: moved(0), 3: moved(-120, 60)}, 3, 0.5, "0123")
    assert other.size == (260, 180)
    # The middle of two pixels is that of the half-size pixel which they become.
    np.testing.assert_allclose(half[3] @ [0.5, 0.5, 1], half[0] @ [-119.5, 60.5, 1])


@pytest.mark.parametrize("factor", [1, -2])
def test_what_reaches_the_horizon_is_refused(factor: int) -> None:
    # The corner of a camera with a field of view of 53 degrees.
    assert planned({0: np.eye(3), 1: factor * turned(40)}).size[0] > 1000
    for degrees in (60, 64, 90, 170):  # at 63 the corner is on the horizon; at 170 all is behind
        with pytest.raises(DeepDetectError, match=r"^1 is"):
            planned({0: np.eye(3), 1: factor * turned(degrees)})


def test_a_canvas_too_large_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    canvas = planned({0: np.eye(3), 1: moved(10_000)})
    with pytest.raises(OptionError, match="10400x300"):
        canvas.check_size(3.1)
    canvas.check_size(3.13)
    monkeypatch.setattr(machine, "available_memory", lambda: 10_400 * 300 * 22)
    with pytest.raises(OptionError):
        canvas.check_size(3.13)


def test_a_canvas_without_a_pixel_is_refused() -> None:
    canvas = planned({0: np.eye(3), 1: moved(100)}, scale=0.001)
    with pytest.raises(OptionError):
        canvas.check_size(1.0)


def test_the_one_in_the_middle_is_least_stretched() -> None:
    angles = {4: -35, 1: 20, 7: 2, 2: 38}
    for frame in (0, 25):
        homographies = {number: turned(-frame) @ turned(a) for number, a in angles.items()}
        assert least_distorted(dict.fromkeys(angles, SIZE), homographies) == 7
    assert least_distorted({2: SIZE, 1: SIZE}, {2: moved(0), 1: moved(50)}) == 2


def test_an_image_is_drawn_where_it_belongs(scene: np.ndarray) -> None:
    canvas, _ = plan_plane({0: (600, 400), 1: SIZE}, {0: moved(40, 10), 1: moved(0)}, 1, 1, "01")
    warped = canvas.draw(0, scene, 1, 1)
    assert warped.corner == (40, 10)
    np.testing.assert_array_equal(warped.image, scene)
    assert (warped.mask == 255).all()
    # Stripes of one pixel are grey when made smaller, not what sampling hits.
    stripes = np.zeros((200, 200, 3), np.uint8)
    stripes[:, ::2] = 255
    canvas, _ = plan_plane({0: (200, 200)}, {0: np.eye(3)}, 0, 0.25, "0")
    small = canvas.draw(0, stripes, 1, 1).image
    assert np.abs(small[5:-5, 5:-5].astype(int) - 127.5).max() < 30


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
            ray = camera.rotation @ np.linalg.inv(Camera(SIZE, camera.focal_px).matrix) @ [x, y, 1]
            seen.append([left + column, top + row])
            true.append(270 * np.array([np.arctan2(ray[0], ray[2]), height(*ray)]))
    offsets = np.array(seen) - true  # of the canvas, the same for all
    assert np.ptp(offsets, axis=0).max() < 4
