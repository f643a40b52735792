"""The slow way gives what the preset `published` gives: it is only timed."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from deepdetect import DeepDetect, WeightsError, match_images
from deepdetect.datasets.middlebury import load_calibrated_pair
from deepdetect.detector.heatmap import HeatmapOptions
from deepdetect.io.image import load_image
from deepdetect.matching import PUBLISHED_MATCHING

pytest.importorskip("torch", reason="the published pipeline runs in torch")


@pytest.fixture(scope="module")
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("published_pipeline")


@pytest.mark.slow
def test_counts_as_the_preset_does(script: ModuleType, photo_path: Path) -> None:
    image = load_image(photo_path)[:240, :320]
    shift = 7
    images = image[:, :-shift], image[:, shift:]
    detector = DeepDetect().configured(HeatmapOptions(480, "bgr"))

    def correct(x: float, y: float, u: float, v: float) -> bool:
        return float(np.hypot(x - shift - u, y - v)) < 1

    counted = script.published_pipeline(images, script.published_detector(detector), correct)
    found = match_images(
        *images,
        detector,
        guided_matching=False,
        model="none",
        options=PUBLISHED_MATCHING,
    )
    gaps = np.linalg.norm(found.points0 - (shift, 0) - found.points1, axis=1)
    expected = int((gaps < 1).sum())
    assert expected > 5000
    assert counted == pytest.approx(expected, rel=0.03)  # FLANN's trees are random


def test_an_image_without_keypoints_gives_none(script: ModuleType) -> None:
    detector = script.published_detector(DeepDetect().configured(HeatmapOptions(480)))
    blank = np.full((60, 80, 3), 128, np.uint8)
    assert script.published_pipeline((blank, blank), detector, lambda *_: True) == 0


def test_weights_without_a_safetensors_file_are_said(
    script: ModuleType, tmp_path: Path, one_line
) -> None:
    weights = tmp_path / "own.onnx"
    weights.write_bytes(DeepDetect().weights.read_bytes())
    with pytest.raises(WeightsError, match=r"own\.safetensors") as caught:
        script.published_detector(DeepDetect(weights))
    one_line(caught.value)


def test_both_sides_are_run_in_turn(script: ModuleType) -> None:
    ran: list[str] = []

    def side(name: str, count: int) -> Callable[[], int]:
        return lambda: ran.append(name) or count

    found = script.compare(side("published", 3), side("ours", 5), rounds=2)
    assert ran == ["published", "ours"] * 3
    (row,) = script.table("correct", [{"pair": "wall 1-6", **found}]).values()
    assert (row["published: correct"], row["ours: correct"]) == (3, 5)
    assert row["lowest"] <= row["times faster"] <= row["highest"]


def test_a_stereo_scene_is_reconstructed_by_both(script: ModuleType, shared: Path) -> None:
    scene = load_calibrated_pair(shared / "data" / "middlebury" / "cones")
    corner = (slice(120, 220), slice(100, 260))
    small = dataclasses.replace(scene, left=scene.left[corner], right=scene.right[corner])
    detector = DeepDetect("dense").configured(HeatmapOptions(480, "bgr"))
    points0, points1 = script.published_points(small, script.published_detector(detector))
    assert len(points0) == len(points1) > 2_000
    assert (np.abs(points0[:, 1] - points1[:, 1]) <= 1).mean() > 0.95
