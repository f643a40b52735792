from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import cv2
import numpy as np
import pytest

from deepdetect.matching import Panorama


@pytest.fixture(scope="module")
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("stitching")


def test_views_show_one_scene(script: ModuleType, photo: np.ndarray) -> None:
    bright = np.tile(photo // 2 + 80, (1, 2, 1))
    scene = cv2.resize(bright, (1200, 600), interpolation=cv2.INTER_CUBIC)
    views = script.render_views(scene, (200, 150), 370.0)
    assert len(views) == 10
    assert all(image.shape == (150, 200, 3) for image, _ in views)
    assert all(image.min() > 20 for image, _ in views)  # no black border
    (first, truth0), (second, truth1) = views[1:3]
    between = np.linalg.inv(truth1) @ truth0
    moved = cv2.warpPerspective(first, between, (200, 150), flags=cv2.INTER_CUBIC)
    seen = cv2.warpPerspective(np.ones((150, 200), np.uint8), between, (200, 150)) == 1
    seen = cv2.erode(seen.astype(np.uint8), np.ones((5, 5))) == 1
    assert 0.3 < seen.mean() < 0.7
    assert np.corrcoef(moved[seen].ravel(), second[seen].ravel())[0, 1] > 0.98
    ratio = moved[seen].astype(float).sum() / second[seen].sum()
    assert abs(ratio - 1) > 0.01  # the exposures differ


def test_corner_errors_are_in_pixels_of_the_reference(script: ModuleType) -> None:
    truths = [np.array([[1, 0.1, 30 * k], [-0.1, 1, 5], [1e-4, 0, 1]]) for k in range(3)]
    canvas = np.array([[2, 0, 7], [0, 2, -9], [0, 0, 1.0]])
    homographies = {k: canvas @ truth for k, truth in enumerate(truths)}
    # Before the canvas doubles it, image 2 lies 3 px to the right and 4 px down of its place.
    to_reference = np.linalg.inv(truths[1]) @ truths[2]
    aside = np.array([[1, 0, 3], [0, 1, 4], [0, 0, 1.0]])
    homographies[2] = canvas @ truths[1] @ aside @ to_reference
    panorama = Panorama(
        np.zeros((4, 4, 3), np.uint8), np.ones((4, 4), bool), homographies, 1, {}, {}, 0.0, {}, {}
    )
    errors = script.corner_errors(panorama, truths, [(50, 40)] * 3)
    assert errors == pytest.approx([0, 5], abs=1e-9)
