"""The slow way gives what `match_unguided` gives: it is only timed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from deepdetect import DeepDetect
from deepdetect.detector.heatmap import HeatmapOptions
from deepdetect.io.image import load_image
from deepdetect_lab.evaluation.unguided import match_unguided

pytest.importorskip("torch", reason="the published pipeline runs in torch")


@pytest.fixture(scope="module")
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("published_pipeline")


@pytest.mark.slow
def test_counts_as_match_unguided_does(script: ModuleType, photo_path: Path) -> None:
    image = load_image(photo_path)[:240, :320]
    shift = 7
    images = image[:, :-shift], image[:, shift:]
    detector = DeepDetect().configured(HeatmapOptions(480, "bgr"))

    def correct(x: float, y: float, u: float, v: float) -> bool:
        return float(np.hypot(x - shift - u, y - v)) < 1

    counted = script.published_pipeline(images, script.published_detector(detector), correct)
    found = match_unguided(*images, detector)
    gaps = np.linalg.norm(found.points0 - (shift, 0) - found.points1, axis=1)
    expected = int((gaps < 1).sum())
    assert expected > 5000
    assert counted == pytest.approx(expected, rel=0.03)  # FLANN's trees are random


def test_both_sides_are_run_in_turn(script: ModuleType) -> None:
    ran: list[str] = []

    def side(name: str, count: int) -> Callable[[], int]:
        return lambda: ran.append(name) or count

    found = script.compare(side("published", 3), side("ours", 5), rounds=2)
    assert ran == ["published", "ours"] * 3
    (row,) = script.table([{"pair": "wall 1-6", **found}]).values()
    assert (row["published: correct"], row["ours: correct"]) == (3, 5)
    assert row["lowest"] <= row["times faster"] <= row["highest"]
