"""Scale photographs to the sizes of training and evaluation."""

from __future__ import annotations

import numpy as np

from deepdetect._shared.opencv import cv2


def scale_short_side(rgb: np.ndarray, short_side: int) -> np.ndarray:
    """Scale an image so that its shorter side has the given length in pixels."""
    height, width = rgb.shape[:2]
    factor = short_side / min(height, width)
    if factor == 1:
        return rgb
    size = (max(round(width * factor), short_side), max(round(height * factor), short_side))
    # Area averaging does not alias when shrinking; cubic keeps edges when enlarging.
    method = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    return cv2.resize(rgb, size, interpolation=method)
