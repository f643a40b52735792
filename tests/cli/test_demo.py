from __future__ import annotations

from pathlib import Path

import numpy as np

from deepdetect.cli.demo import run_demo


class FakeDetector:
    """Every fourth pixel of the texture."""

    def heatmap(self, image: np.ndarray) -> np.ndarray:
        heatmap = np.zeros(image.shape[:2], np.float32)
        heatmap[8:-8:2, 8:-8:2] = 0.9
        return heatmap


def test_a_shifted_copy_is_matched_right(tmp_path: Path) -> None:
    """The right view is the left one moved by 6 pixels: the truth is exact."""
    import cv2

    noise = np.random.default_rng(0).integers(0, 256, (40, 60, 3), np.uint8)
    texture = cv2.resize(noise, (120, 80), interpolation=cv2.INTER_CUBIC)
    views, truth = (texture[:, :-6], texture[:, 6:]), np.full((80, 114), 6.0, np.float32)
    result = run_demo(*views, truth, FakeDetector(), tmp_path)
    assert result["all_matches"]["precision"] > 0.9
    assert result["inliers"]["precision"] >= result["all_matches"]["precision"]
    assert result["random"]["precision"] < result["all_matches"]["precision"]
    assert result["all_matches"]["evaluated"] == result["all_matches"]["matches"]
    assert {path.name for path in result["pictures"]} == {path.name for path in tmp_path.iterdir()}
    wrong = run_demo(*views, truth + 3, FakeDetector(), tmp_path)
    assert wrong["all_matches"]["precision"] < 0.1
