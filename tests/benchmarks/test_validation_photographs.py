from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetect
from deepdetect.io.image import load_image, luma
from deepdetect_lab.labels import fuse
from deepdetect_lab.training.augmentation import darken
from deepdetect_lab.training.recipe import Stage, TrainingOptions
from deepdetect_lab.training.views import list_images, render

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "validation_photographs.py"


def test_scores_both_lights_against_their_own_labels(photo_path: Path) -> None:
    side = 320
    command = [sys.executable, str(BENCHMARK), str(photo_path.parent), "--short-side", str(side)]
    command += ["--weights", "default"]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    rows = [line.strip("| ").split(" | ") for line in printed.splitlines()[2:]]
    assert [row[:2] for row in rows] == [["default", "normal"], ["default", "darkened"]]
    options = TrainingOptions(stages=(Stage(240, 1, 1),), short_sides=(side,))
    normal, dark = list_images(photo_path.parent, options, ())[0].validation_views
    bright = render(load_image(photo_path), normal)
    assert min(bright.shape[:2]) == side
    assert dark.darkening is not None
    views = bright, darken(bright, dark.darkening)
    for (*_, count, _, iou, error, density, of_labels), view in zip(rows, views, strict=True):
        visibility = "normal" if view is bright else "low"
        label = fuse(luma(view))
        heatmap = DeepDetect(resolution="native").heatmap(view)
        assert (count, label.visibility) == ("1", visibility)
        assert float(of_labels) == pytest.approx(label.mask.mean(), abs=1e-4)
        assert float(density) == pytest.approx((heatmap > 0.5).mean(), abs=1e-3)
        both, either = label.mask & (heatmap > 0.5), label.mask | (heatmap > 0.5)
        assert float(iou) == pytest.approx(both.sum() / either.sum(), abs=2e-3)
        # The whole error is no smaller than that of the mean.
        assert float(error) >= abs(np.float64(heatmap.mean()) - label.mask.mean()) - 1e-3
