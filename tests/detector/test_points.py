from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect._shared.errors import OptionError
from deepdetect.detector.points import PyramidOptions, detect_points, pyramid, to_full


def blobs(centers, sigma: float, side: int = 128) -> np.ndarray:
    row, column = np.indices((side, side))
    total = sum(np.exp(-((column - x) ** 2 + (row - y) ** 2) / (2 * sigma**2)) for x, y in centers)
    return np.uint8(np.rint(200 * total))


def brightness(gray: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(gray, (0, 0), 1) - cv2.GaussianBlur(gray, (0, 0), 2)


@pytest.mark.parametrize("sigma", [1.5, 3.0, 6.0])
def test_blobs_of_all_sizes_are_found_once_and_in_place(sigma: float) -> None:
    centers = np.array([[30.2, 40.7], [90.6, 70.1]])
    found = detect_points(blobs(centers, sigma), brightness)
    best = found[:2]
    order = np.argsort(best.xy[:, 0])
    np.testing.assert_allclose(best.xy[order], centers, atol=0.25)
    assert (np.diff(found.logits) <= 0).all()
    gaps = np.linalg.norm(found.xy[:, None] - found.xy[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    assert gaps.min() >= 2


def test_sizes_follow_the_levels() -> None:
    fine, coarse = (detect_points(blobs([(64, 64)], s), brightness)[0].sizes[0] for s in (1.5, 6))
    assert coarse > 2 * fine


def test_small_images_have_fewer_levels() -> None:
    assert len(pyramid(np.zeros((20, 200), np.float32))) == 1
    assert len(pyramid(np.zeros((500, 400), np.float32), PyramidOptions(levels=3))) == 3


def test_positions_of_levels_are_those_of_the_same_places() -> None:
    """The outer edges of both images are the same."""
    edge = to_full(np.array([[-0.5, -0.5], [31.5, 15.5]]), (32, 16), (100, 70))
    np.testing.assert_allclose(edge, [[-0.5, -0.5], [99.5, 69.5]])


@pytest.mark.parametrize("change", [{"levels": 0}, {"factor": 1.0}, {"nms_radius": 0}])
def test_wrong_options_are_reported(change) -> None:
    with pytest.raises(OptionError):
        PyramidOptions(**change)
