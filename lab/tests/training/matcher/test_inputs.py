from __future__ import annotations

from typing import Any

import numpy as np

from deepdetect import Keypoints
from deepdetect_lab.training.matcher.inputs import attention_inputs


def test_inputs_of_turned_keypoints_are_upright() -> None:
    rng = np.random.default_rng(0)
    described = rng.standard_normal((300, 64)).astype(np.float32)
    described /= np.linalg.norm(described, axis=1, keepdims=True)
    xy, angles = rng.uniform(0, 400, (300, 2)), rng.uniform(0, 360, 300)
    c, s = np.cos(np.radians(70)), np.sin(np.radians(70))
    common: dict[str, Any] = {
        "scores": np.ones(300),
        "sizes": np.full(300, 9.0),
        "image_size": (401, 401),
        "descriptors": described,  # turned to the keypoints' own angles, so that they are alike
        "descriptor_type": "learned",
    }
    first = Keypoints(xy=xy, angles=angles, **common)
    turned = (xy - 200) @ np.array([[c, s], [-s, c]]) + 200  # by 70 degrees from x to y
    inputs = attention_inputs(first, Keypoints(xy=turned, angles=(angles + 70) % 360, **common))
    for name in ("xy", "descriptors", "traits"):
        np.testing.assert_allclose(inputs[f"{name}1"], inputs[f"{name}0"], atol=2e-3)
