from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect import OptionError
from deepdetect.io.image import find_images
from deepdetect_lab.training.descriptor import crops, views
from deepdetect_lab.training.descriptor.crops import CROP_POINTS, CROP_PX, draw_crop, draw_crops
from deepdetect_lab.training.teachers.readings import load_reading


def test_a_crop_shows_its_points_where_they_were_read(
    made_readings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("UNCHANGED_SHARE", "JITTER_PX"):
        monkeypatch.setattr(views, name, 1.0)
    monkeypatch.setattr(crops, "JITTER_PX", 0.0)
    reading = load_reading(made_readings / "0.npz")
    crop = draw_crop(np.random.default_rng(0), reading)
    assert crop is not None
    assert crop.images.shape == (CROP_PX, CROP_PX)
    known = {code.tobytes(): k for k, code in enumerate(reading.codes)}
    rows = [known[code.tobytes()] for code in crop.codes]
    offsets = reading.xy[rows] - crop.positions
    x, y = np.rint(offsets[0]).astype(int)
    np.testing.assert_allclose(offsets, np.tile([x, y], (CROP_POINTS, 1)), atol=1e-4)
    expected = reading.luma[y : y + CROP_PX, x : x + CROP_PX]
    assert np.abs(crop.images.astype(int) - expected).max() <= 1
    worse = (reading.scores[:, 1] < reading.scores[rows[0], 1]).mean()
    assert crop.survival[0] == pytest.approx(worse, abs=0.01)
    assert 0 <= crop.survival.min() < 0.1 < 0.9 < crop.survival.max() < 1


def test_photographs_that_are_not_yet_read_are_left_out(
    textures: Path, made_readings: Path, tmp_path: Path
) -> None:
    files = find_images(textures)
    batch = draw_crops(files, made_readings, 3, np.random.default_rng(1))
    assert batch.codes.shape == (3, CROP_POINTS, 192)
    again = draw_crops(files, made_readings, 3, np.random.default_rng(1))
    assert all(map(np.array_equal, batch, again))
    with pytest.raises(OptionError, match="read the teachers first"):
        draw_crops(files, tmp_path, 1, np.random.default_rng(1))


def test_nothing_is_drawn_where_nothing_was_read(made_readings: Path) -> None:
    reading = load_reading(made_readings / "0.npz")
    nowhere = reading._replace(xy=np.zeros_like(reading.xy))
    assert draw_crop(np.random.default_rng(0), nowhere) is None
