from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetect, ImageError, OptionError
from deepdetect.detector.heatmap import HeatmapOptions
from deepdetect.evaluation.scale_quality import scale_quality
from deepdetect.io.image import luma
from deepdetect.labels import fuse
from deepdetect.training.augmentation import Darkening
from deepdetect.training.views import View, render


class Labels:
    """A detector that knows the labels."""

    def __init__(self) -> None:
        self.sizes: list[tuple[int, int]] = []

    def configured(self, options: HeatmapOptions) -> Labels:
        assert options == HeatmapOptions(), "native resolution"
        return self

    def heatmap(self, rgb: np.ndarray) -> np.ndarray:
        self.sizes.append(rgb.shape[:2])
        return fuse(luma(rgb)).mask.astype(np.float32)


def test_a_detector_that_knows_the_labels_has_full_marks(photo: np.ndarray) -> None:
    dark = (photo * 0.15).astype(np.uint8)
    detector, steps = Labels(), []
    (rows,) = scale_quality([detector], [photo, dark], (0.5, 2), done=steps.append)
    assert [(row.scale, row.visibility) for row in rows] == [
        (scale, visibility) for scale in (0.5, 2) for visibility in ("normal", "low")
    ]
    assert len(steps) == 4
    height, width = photo.shape[:2]
    assert detector.sizes[0] == (round(height / 2), round(width / 2))
    assert detector.sizes[2] == (2 * height, 2 * width)
    for row in rows:
        assert row.score.iou == 1
        assert row.score.loss < 1e-6
        assert row.density == pytest.approx(row.label_density)
        assert 0 < row.density < 1


@pytest.mark.parametrize("scale", [0, -1, float("nan"), float("inf")])
def test_nonsense_is_refused(photo: np.ndarray, scale: float) -> None:
    with pytest.raises(OptionError, match="above 0"):
        scale_quality([Labels()], [photo], (1, scale))


@pytest.mark.parametrize("scale", [0.02, 1e-6])
def test_an_image_must_not_vanish(photo: np.ndarray, scale: float) -> None:
    with pytest.raises(ImageError, match="at least 16"):
        scale_quality([Labels()], [photo], (scale,))


@pytest.mark.parametrize("darkening", [None, Darkening(0.3, 0.4)])
def test_the_bundled_weights_hold_from_half_to_twice_the_size(
    shared: Path, darkening: Darkening | None
) -> None:
    """Photographs held out, scaled and then darkened, against labels of their own.

    The scales are those of the training, 240 to 960 pixels, around the 480 of the photographs.
    """
    photos = sorted((shared / "data" / "photos" / "val").glob("*.jpg"))[::32]
    rows = {}
    for side in (240, 480, 960):
        views = [render(path, View(side, darkening)) for path in photos]
        (rows[side],) = scale_quality([DeepDetect()], views, (1,))
    for side in (240, 960):
        (row,), (middle,) = rows[side], rows[480]
        assert row.visibility == middle.visibility == ("normal" if darkening is None else "low")
        dark = 0 if darkening is None else 1
        assert row.score.iou > middle.score.iou - (0.03, 0.12)[dark]
        # Small images have more to mark: the loss of the paper's weights is 3 to 12 times as large.
        assert row.score.loss < 1.4 * middle.score.loss
        assert row.density == pytest.approx(row.label_density, rel=(0.1, 0.3)[dark])


def test_the_command_prints_a_row_for_each_scale(run_evaluate) -> None:
    text = run_evaluate("--scale", "0.5", "--scale", "2")
    lines = [line.split() for line in text.splitlines()]
    assert any(line[:2] == ["x0.5", "normal"] for line in lines)
    assert any(line[:2] == ["x2", "normal"] for line in lines)
