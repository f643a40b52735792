from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect import OptionError
from deepdetect.io.image import find_images
from deepdetect_lab.training.descriptor import crops, views
from deepdetect_lab.training.descriptor.crops import CROP_POINTS, CROP_PX, draw_crop, draw_crops
from deepdetect_lab.training.synthetic import rotation
from deepdetect_lab.training.teachers.readings import load_reading


def test_a_crop_shows_its_points_where_they_were_read(
    made_readings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(views, "UNCHANGED_SHARE", 1.0)
    monkeypatch.setattr(crops, "JITTER_PX", 0.0)
    reading = load_reading(made_readings / "0.npz")
    known = {code.tobytes(): k for k, code in enumerate(reading.codes)}
    smooth = cv2.GaussianBlur(reading.luma, (0, 0), 2).astype(np.float32)
    for seed in range(4):
        crop = draw_crop(np.random.default_rng(seed), reading)
        assert crop is not None
        assert crop.images.shape == (CROP_PX, CROP_PX)
        rows = [known[code.tobytes()] for code in crop.codes]
        # The points move as the turn says, about some centre.
        away = [each - each.mean(0) for each in (reading.xy[rows], crop.positions)]
        moved = away[0] @ rotation(float(crop.turn)).T
        scale = (moved * away[1]).sum() / (moved**2).sum()
        np.testing.assert_allclose(scale * moved, away[1], atol=1e-3)
        seen = cv2.GaussianBlur(crop.images, (0, 0), 2 * scale)
        values = [
            cv2.remap(image.astype(np.float32), at[None], None, cv2.INTER_LINEAR)[0]
            for image, at in ((smooth, reading.xy[rows]), (seen, crop.positions))
        ]
        assert np.corrcoef(values)[0, 1] > 0.98
        worse = (reading.scores < reading.scores[rows[0]]).mean()
        assert crop.survival[0] == pytest.approx(worse, abs=0.01)


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
    nowhere = nowhere._replace(xy=nowhere.xy - 900)
    assert draw_crop(np.random.default_rng(0), nowhere) is None
