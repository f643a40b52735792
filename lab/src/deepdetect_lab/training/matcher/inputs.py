"""The inputs of the matcher: keypoints of two images, with the rotation between them undone."""

from __future__ import annotations

from functools import partial

import numpy as np

from deepdetect.features.keypoints import Keypoints
from deepdetect.features.learned import (
    LEARNED,
    UPRIGHT_DEGREES,
    match_learned,
    ratio_limit,
    turn_descriptors,
)
from deepdetect.features.matchers import exact_neighbours, match_descriptors

MEAN_LOG_SIZE = 2.5
"""Approximate mean of the logarithm of keypoint sizes in pixels; the network reads deviations."""


def attention_inputs(features0: Keypoints, features1: Keypoints) -> dict[str, np.ndarray]:
    """Return the network's inputs by name, with the rotation between the images undone.

    `xy0` (N, 2) are positions relative to the middle of the image, in units of half its longer
    side. `descriptors0` (N, 64) are upright. `traits0` (N, 4) are the logarithm of the size, the
    cosine and the sine of the angle, and the score. The same for the second image.
    """
    match = partial(
        match_descriptors, matcher=exact_neighbours, ratio=ratio_limit(LEARNED), mutual=True
    )
    turn = (match_learned(features0, features1, match)[1] + 180) % 360 - 180
    turn = 0.0 if abs(turn) < UPRIGHT_DEGREES else turn
    inputs: dict[str, np.ndarray] = {}
    for number, (features, degrees) in enumerate(((features0, 0.0), (features1, turn))):
        assert features.descriptors is not None
        assert features.sizes is not None
        assert features.angles is not None
        size, angles = np.array(features.image_size), np.radians(features.angles - degrees)
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        placed = (features.xy - (size - 1) / 2) @ np.array([[c, -s], [s, c]]) / (size.max() / 2)
        traits = [
            np.log(features.sizes) - MEAN_LOG_SIZE,
            np.cos(angles),
            np.sin(angles),
            features.scores,
        ]
        inputs[f"xy{number}"] = placed.astype(np.float32)
        inputs[f"descriptors{number}"] = turn_descriptors(
            features.descriptors, features.angles - degrees
        )
        inputs[f"traits{number}"] = np.column_stack(traits).astype(np.float32)
    return inputs
