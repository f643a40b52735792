from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect_lab.training.points.views import KINDS, degrade, draw_pair, render, tilted_view


@pytest.mark.parametrize("kind", KINDS)
def test_the_homography_takes_one_view_onto_the_other(photo, kind: str) -> None:
    pair = draw_pair(photo, kind, 128, np.random.default_rng(0))
    warped = cv2.warpPerspective(pair.images[0], pair.homography, (128, 128))
    shown = cv2.warpPerspective(
        pair.valid[0].astype(np.uint8), pair.homography, (128, 128), flags=cv2.INTER_NEAREST
    )
    both = pair.valid[1] & (shown > 0)
    assert pair.kind == kind
    assert both.sum() > 50
    assert np.corrcoef(warped[both], pair.images[1][both])[0, 1] > 0.6


@pytest.mark.parametrize("scale", [0.4, 1.0, 1.7])
def test_views_are_in_place_to_a_tenth_of_a_pixel(scale: float) -> None:
    """A blob between pixels lies where the matrix takes its centre."""
    row, column = np.indices((200, 200))
    blob = np.exp(-((column - 103.3) ** 2 + (row - 95.6) ** 2) / (2 * 9.0**2))
    matrix = tilted_view(96, np.array([100.0, 100.0]), scale, angle=0.4, tilt=0.3)
    view, _ = render(np.uint8(200 * blob), matrix, 96)
    x, y, w = matrix @ [103.3, 95.6, 1]
    # The mean of a tilted blob is not its centre: only its peak.
    weight = np.where(view > 0.8 * view.max(), view.astype(float) - 0.8 * view.max(), 0)
    mean = [(weight * axis).sum() / weight.sum() for axis in np.indices(view.shape)[::-1]]
    np.testing.assert_allclose(mean, (x / w, y / w), atol=0.15)


def test_validity_ends_where_the_photograph_does(photo) -> None:
    side = photo.shape[0]
    view, valid = render(photo, np.array([[1, 0, 40], [0, 1, 0], [0, 0, 1.0]]), side)
    assert not valid[:, :44].any()
    assert valid[20:-20, 60:].all()
    np.testing.assert_allclose(view[20:-20, 60:-4], photo[20:-20, 20:-44], atol=6)


def test_kinds_degrade_as_they_say(photo) -> None:
    def sharpness(image: np.ndarray) -> float:
        return float(cv2.Laplacian(image, cv2.CV_32F).std() / image.std())

    generator = np.random.default_rng(0)
    blurred = np.mean([sharpness(degrade(photo, "blur", generator)) for _ in range(8)])
    plain = np.mean([sharpness(degrade(photo, "", generator)) for _ in range(8)])
    assert blurred < 0.7 * plain
    lights = [degrade(photo, "light", generator).mean() for _ in range(8)]
    assert np.std(lights) > 10
