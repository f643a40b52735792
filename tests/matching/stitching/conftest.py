from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest


@dataclass(frozen=True, eq=False)
class Views:
    """Three views of one photograph, (280, 300, 3) each, and the homographies to them from it."""

    scene: np.ndarray
    images: list[np.ndarray]
    homographies: list[np.ndarray]


@pytest.fixture(scope="session")
def views() -> Views:
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    scene = np.ascontiguousarray(data.coffee())  # (400, 600, 3)
    homographies = [
        np.array([[0.98, 0.05, -18.0], [-0.04, 0.99, -40.0], [1e-4, -5e-5, 1]]),
        np.array([[1.02, -0.06, -128.0], [0.05, 1.01, -70.0], [0, 1e-4, 1]]),
        np.array([[1.0, 0.06, -280.0], [-0.05, 1.02, -26.0], [-5e-5, 0, 1]]),
    ]
    images = [
        cv2.warpPerspective(scene, homography, (300, 280), flags=cv2.INTER_CUBIC)
        for homography in homographies
    ]
    for image, homography in zip(images, homographies, strict=True):
        whole = np.full(scene.shape[:2], 255, np.uint8)
        inside = cv2.warpPerspective(whole, homography, image.shape[1::-1])
        assert inside.min() == 255  # no view reaches over the photograph
    return Views(scene, images, homographies)
