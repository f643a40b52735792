"""The pixel convention of the whole package: x right, y down, centre of the first pixel (0, 0).

The images are not square and nothing is drawn on a diagonal, so that swapped axes fail.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from deepdetect.detector.heatmap import HeatmapOptions, compute_maps
from deepdetect.features.selection import select_keypoints
from deepdetect_lab.labels import DETECTORS
from deepdetect_lab.labels.detectors import pixels_mask


def compute_heatmap(rgb: np.ndarray, *arguments: Any) -> np.ndarray:
    return compute_maps(rgb, *arguments).both()[0]


def to_logits(probability: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        wide = probability.astype(np.float64)
        return (np.log(wide) - np.log1p(-wide)).astype(np.float32)


def brightness(planes: np.ndarray) -> np.ndarray:
    """A network whose probability is the brightness of the pixel."""
    return to_logits(planes.mean(1, keepdims=True))


def place(planes: np.ndarray) -> np.ndarray:
    """A network whose probability at (x, y) is (3 x + y) / 1000, whatever the image."""
    height, width = planes.shape[2:]
    rows, columns = np.mgrid[:height, :width]
    return to_logits(((3 * columns + rows) / 1000)[None, None])


def dot(x: int, y: int, height: int = 30, width: int = 50) -> np.ndarray:
    rgb = np.zeros((height, width, 3), np.uint8)
    rgb[y, x] = 255
    return rgb


def test_points_are_x_then_y() -> None:
    mask = pixels_mask((30, 50), np.array([[37.0, 12.0], [0.0, 0.0], [49.4, 29.4]]))
    assert mask[12, 37]
    assert mask[0, 0]
    assert mask[29, 49]
    assert mask.sum() == 3


@pytest.mark.parametrize(("x", "column"), [(-0.4, 0), (0.0, 0), (0.4, 0), (0.6, 1)])
def test_the_first_pixel_reaches_from_minus_a_half_to_a_half(x: float, column: int) -> None:
    assert np.argwhere(pixels_mask((4, 6), np.array([[x, 2.0]]))).tolist() == [[2, column]]


def test_opencv_keypoints_share_the_convention() -> None:
    gray = dot(37, 12)[:, :, 0]
    corners = cv2.FastFeatureDetector_create(13, False).detect(gray, None)
    assert [corner.pt for corner in corners] == [(37.0, 12.0)]
    assert np.argwhere(pixels_mask(gray.shape, cv2.KeyPoint_convert(corners))).tolist() == [
        [12, 37]
    ]


@pytest.mark.parametrize(("x", "y"), [(0, 0), (49, 0), (0, 29), (37, 12)])
def test_selected_keypoints_are_x_then_y_on_pixel_centres(x: int, y: int) -> None:
    heatmap = np.zeros((30, 50), np.float32)
    heatmap[y, x] = 0.75
    keypoints = select_keypoints(heatmap)
    assert keypoints.xy.tolist() == [[x, y]]
    assert keypoints.image_size == (50, 30)


@pytest.mark.parametrize(("x", "y"), [(0, 0), (49, 0), (0, 29), (37, 12)])
def test_the_native_heat_map_lies_on_the_images_pixels(x: int, y: int) -> None:
    heatmap = compute_heatmap(dot(x, y), brightness)
    assert np.argwhere(heatmap > 0.5).tolist() == [[y, x]]
    assert select_keypoints(heatmap).xy.tolist() == [[x, y]]


def test_padding_leaves_places_as_they_are() -> None:
    heatmap = compute_heatmap(dot(37, 12), place)  # 30x50 is padded to 32x56
    rows, columns = np.mgrid[:30, :50]
    np.testing.assert_allclose(heatmap, (3 * columns + rows) / 1000, atol=1e-6)


@pytest.mark.parametrize("side", [32, 64, 128])
def test_a_squashed_heat_map_keeps_pixel_centres(side: int) -> None:
    height, width = 45, 120
    heatmap = compute_heatmap(dot(37, 12, height, width), place, HeatmapOptions(side))
    # The centre of pixel x lies (x + 1/2) / width along the image, also when squashed.
    columns = (np.arange(width) + 0.5) * side / width - 0.5
    rows = (np.arange(height) + 0.5) * side / height - 0.5
    expected = (3 * columns[None] + rows[:, None]) / 1000
    inner = np.s_[8:-8, 8:-8]  # cubic interpolation bends at the border
    np.testing.assert_allclose(heatmap[inner], expected[inner], atol=2e-4)


@pytest.mark.parametrize("side", [48, 96])
def test_a_squashed_image_is_seen_in_its_place(side: int) -> None:
    rows, columns = np.mgrid[:60, :150]
    bump = np.exp(-((columns - 93) ** 2 / 200 + (rows - 22) ** 2 / 50))
    rgb = np.rint(255 * bump).astype(np.uint8)[:, :, None].repeat(3, 2)
    heatmap = compute_heatmap(rgb, brightness, HeatmapOptions(side)).astype(np.float64)
    assert (heatmap * columns).sum() / heatmap.sum() == pytest.approx(93, abs=0.1)
    assert (heatmap * rows).sum() / heatmap.sum() == pytest.approx(22, abs=0.1)


# How far a detector's marks may lie from the corner: half the width of its filters.
REACH = {
    "orb": 2,
    "brisk": 2,
    "fast": 2,
    "agast": 2,
    "harris": 4,
    "shi-tomasi": 1,
}


@pytest.mark.parametrize("name", REACH)
def test_corner_detectors_mark_a_drawn_corner(name: str) -> None:
    gray = np.zeros((60, 100), np.uint8)
    gray[21:, 62:] = 200  # one corner, at column 62 and row 21
    marked = np.argwhere(DETECTORS[name].mask(gray))[:, ::-1]
    assert len(marked) > 0
    assert np.abs(marked - (62, 21)).max() <= REACH[name]


@pytest.mark.parametrize("name", ["canny", "sobel"])
def test_edge_detectors_mark_a_drawn_corner(name: str) -> None:
    gray = np.zeros((60, 100), np.uint8)
    gray[21:, 62:] = 200
    mask = DETECTORS[name].mask(gray)
    row, column = np.nonzero(mask)
    # Nothing left of or above the corner's sides, and both sides are found.
    assert column.min() in range(58, 63)
    assert row.min() in range(17, 22)
    assert mask[40, 58:66].any()
    assert mask[17:25, 80].any()
    assert not mask[30:, 70:].any()


def test_sift_marks_a_drawn_blob() -> None:
    rows, columns = np.mgrid[:60, :100]
    gray = np.rint(200 * np.exp(-((columns - 62) ** 2 + (rows - 21) ** 2) / 32)).astype(np.uint8)
    assert DETECTORS["sift"].mask(gray)[21, 62]
