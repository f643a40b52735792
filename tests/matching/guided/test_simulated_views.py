from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect import Keypoints
from deepdetect.matching.guided.simulated_views import simulate_view, simulated_views


def blob(x: float, y: float, across: float, down: float) -> np.ndarray:
    """A bright spot of a given sigma in pixels on dark ground."""
    row, column = np.indices((160, 220))
    away = ((column - x) / across) ** 2 + ((row - y) / down) ** 2
    return np.rint(40 + 180 * np.exp(-away / 2)).astype(np.uint8)


@pytest.mark.parametrize("tilt", [2.0, 4.0])
@pytest.mark.parametrize("turn", [0.0, 25.0, 144.0])
def test_a_spot_lies_where_the_map_says(tilt: float, turn: float) -> None:
    view, affine = simulate_view(blob(130, 60, 6, 6), tilt, turn)
    bright = np.maximum(view.astype(float) - 140, 0)  # above the grey outside
    row, column = np.indices(view.shape)
    centre = np.array([(bright * column).sum(), (bright * row).sum()]) / bright.sum()
    np.testing.assert_allclose(centre, affine @ [130, 60, 1], atol=0.1)


@pytest.mark.parametrize("tilt", [2.0, 4.0])
@pytest.mark.parametrize("turn", [0.0, 40.0, 110.0])
def test_the_whole_image_is_within_the_view_and_grey_outside(tilt: float, turn: float) -> None:
    view, affine = simulate_view(np.full((90, 140), 250, np.uint8), tilt, turn)
    height, width = view.shape
    corners = np.array([[0, 0, 1], [139, 0, 1], [139, 89, 1], [0, 89, 1]]) @ affine.T
    assert (corners > -1).all()
    assert (corners < (width + 0.5, height + 0.5)).all()  # a column less, at the most
    assert (corners.min(axis=0) < 1).all()  # no room beside it
    assert (corners.max(axis=0) > (width - 2.5, height - 2.5)).all()
    row, column = np.indices(view.shape)
    back = cv2.invertAffineTransform(affine)
    x, y = back @ np.stack([column.ravel(), row.ravel(), np.ones(view.size)])
    far = 4 * tilt  # pixels of blur
    out = (x < -far) | (y < -far) | (x > 139 + far) | (y > 89 + far)
    inside = (x > far) & (y > far) & (x < 139 - far) & (y < 89 - far)
    assert (view.ravel()[out] == 128).all()
    assert (np.abs(view.ravel()[inside].astype(int) - 250) <= 1).all()
    assert inside.any()


@pytest.mark.parametrize("tilt", [2.0, 4.0])
def test_fine_stripes_are_blurred_before_they_are_shortened(tilt: float) -> None:
    """Else they would come back as coarse ones."""
    stripes = np.zeros((80, 160), np.uint8)
    stripes[:, ::2] = 255
    view, _ = simulate_view(stripes, tilt, 0.0)
    assert np.ptp(view[10:-10, 5:-5].astype(int)) < 30
    upright, _ = simulate_view(stripes.T.copy(), tilt, 0.0)
    assert np.ptp(upright[10:-10, 5:-5].astype(int)) == 255  # the height is not touched


def spots(view: np.ndarray) -> Keypoints:
    """Find spots with OpenCV's SIFT."""
    found = cv2.SIFT_create(100, enable_precise_upscale=True).detect(view, None)
    return Keypoints.from_opencv(found, view.shape[::-1])


def test_keypoints_lie_at_their_positions_in_the_image_itself() -> None:
    """A spot four times wider than high is round in the view without a turn."""
    gray = blob(110, 70, 12, 3)
    side, found = next(simulated_views((gray, gray), spots))
    assert side == 0
    gaps = found.xy - [110, 70]
    near = gaps[np.argmin(np.linalg.norm(gaps, axis=1))]
    assert abs(near[0]) < 0.6
    assert abs(near[1]) < 0.15
