from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepdetect import Calibration, Camera, ReconstructionError
from deepdetect.sfm.intrinsics import known_cameras, photograph_lenses

SIZES = {"a.jpg": (640, 480), "b.jpg": (640, 480), "c.jpg": (320, 240)}


def write(folder: Path, name: str, focal_35mm: int | None) -> None:
    exif = Image.Exif()
    if focal_35mm is not None:
        exif.get_ifd(0x8769)[0xA405] = focal_35mm
    Image.new("RGB", SIZES[name]).save(folder / name, exif=exif)


def test_photographs_of_one_size_and_focal_length_share_a_camera(tmp_path: Path) -> None:
    for name in SIZES:
        write(tmp_path, name, 28)
    lenses = photograph_lenses(tmp_path, list(SIZES), SIZES, {})
    assert lenses["a.jpg"] is lenses["b.jpg"]
    assert lenses["c.jpg"] is not lenses["a.jpg"]
    assert {lens.source for lens in lenses.values()} == {"EXIF"}
    expected = 28 * np.hypot(640, 480) / np.hypot(36, 24)
    assert lenses["a.jpg"].params[0] == pytest.approx(expected)
    write(tmp_path, "b.jpg", 50)
    zoomed = photograph_lenses(tmp_path, list(SIZES), SIZES, {})
    assert zoomed["a.jpg"] is not zoomed["b.jpg"]
    assert zoomed["b.jpg"].params[0] > zoomed["a.jpg"].params[0]
    one = photograph_lenses(tmp_path, list(SIZES), SIZES, {}, single_camera=True)
    assert one["a.jpg"] is one["b.jpg"]
    each = photograph_lenses(tmp_path, list(SIZES), SIZES, {}, single_camera=False)
    assert len({id(lens) for lens in each.values()}) == 3


def test_without_exif_the_focal_length_is_given_or_guessed(tmp_path: Path) -> None:
    write(tmp_path, "a.jpg", None)
    (guessed,) = photograph_lenses(tmp_path, ["a.jpg"], SIZES, {}).values()
    assert (guessed.source, guessed.params[0]) == ("estimated", 1.2 * 640)
    (given,) = photograph_lenses(tmp_path, ["a.jpg"], SIZES, {}, 555.0).values()
    assert (given.source, given.params[0]) == ("focal_px", 555.0)
    with pytest.raises(ReconstructionError, match="above 0"):
        photograph_lenses(tmp_path, ["a.jpg"], SIZES, {}, -3.0)


def test_a_calibration_is_for_one_size() -> None:
    camera = Camera((640, 480), 500.0)
    for calibration in (camera, Calibration(camera, camera)):
        found = known_cameras(calibration, SIZES)
        assert found.known == {"a.jpg": camera, "b.jpg": camera}
        assert list(found.refused) == ["c.jpg"]
    assert known_cameras(None, SIZES).known == {}
    with pytest.raises(ReconstructionError, match="640x480"):
        known_cameras(camera, {"c.jpg": SIZES["c.jpg"]})
