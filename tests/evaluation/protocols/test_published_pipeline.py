"""The slow way gives what the preset `published` gives: it is only timed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetect, WeightsError, match_images
from deepdetect.detector.heatmap import HeatmapOptions
from deepdetect.evaluation.protocols.published_pipeline import (
    published_detector,
    published_pipeline,
)
from deepdetect.io.image import load_image

pytest.importorskip("torch", reason="the published pipeline runs in torch")


def test_counts_as_the_preset_does(photo_path: Path) -> None:
    image = load_image(photo_path)[:240, :320]
    shift = 7
    images = image[:, :-shift], image[:, shift:]
    detector = DeepDetect().configured(HeatmapOptions(480, "bgr"))

    def right(x: float, y: float, u: float, v: float) -> bool:
        return float(np.hypot(x - shift - u, y - v)) < 1

    counted = published_pipeline(images, published_detector(detector), right)
    found = match_images(*images, detector, preset="published")
    gaps = np.linalg.norm(found.points0 - (shift, 0) - found.points1, axis=1)
    expected = int((gaps < 1).sum())
    assert expected > 5000
    assert counted == pytest.approx(expected, rel=0.03)  # FLANN's trees are random


def test_an_image_without_keypoints_gives_none() -> None:
    detector = published_detector(DeepDetect().configured(HeatmapOptions(480)))
    blank = np.full((60, 80, 3), 128, np.uint8)
    assert published_pipeline((blank, blank), detector, lambda *_: True) == 0


def test_weights_without_a_safetensors_file_are_said(tmp_path: Path, one_line) -> None:
    weights = tmp_path / "own.onnx"
    weights.write_bytes(DeepDetect().weights.read_bytes())
    with pytest.raises(WeightsError, match=r"own\.safetensors") as caught:
        published_detector(DeepDetect(weights))
    one_line(caught.value)
