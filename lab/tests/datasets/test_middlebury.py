from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepdetect import ImageError, ReconstructionError
from deepdetect_lab.datasets import load_motorcycle
from deepdetect_lab.datasets.middlebury import load_calibrated_pair, load_middlebury


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Views of 32x16 pixels, and a map of half their size."""
    for name in ("left", "right"):
        Image.fromarray(np.zeros((16, 32, 3), np.uint8)).save(tmp_path / f"{name}.png")
    stored = np.arange(8 * 16, dtype=np.uint8).reshape(8, 16)
    Image.fromarray(stored).save(tmp_path / "disparity.png")
    truth = {"file": "disparity.png", "value_per_pixel": 4.0, "unknown": 0}
    (tmp_path / "calib.json").write_text(json.dumps({"ground_truth": truth}))
    return tmp_path


def test_a_small_map_is_read_at_each_pixel(scene: Path) -> None:
    disparity = load_middlebury(scene).disparity
    assert disparity.shape == (16, 32)
    assert disparity.dtype == np.float32
    assert np.isnan(disparity[:2, :2]).all()
    assert np.isfinite(disparity[2:]).all()
    np.testing.assert_array_equal(disparity[2:4, 4:6], np.full((2, 2), 18 / 4))
    assert disparity[-1, -1] == 127 / 4


LARGE = [
    pytest.param(name, marks=pytest.mark.slow) for name in ("teddy", "art", "dolls", "moebius")
]


@pytest.mark.parametrize("name", ["cones", "motorcycle", *LARGE])
def test_the_truth_fits_the_photographs(shared: Path, name: str) -> None:
    """The right view, sampled at x - disparity, looks like the left view; at x + it does not."""
    scene = shared / "data" / "middlebury" / name
    pair = load_motorcycle() if name == "motorcycle" else load_middlebury(scene)
    height, width = pair.disparity.shape
    assert pair.left.shape == pair.right.shape == (height, width, 3)
    known = np.isfinite(pair.disparity)
    assert known.mean() > 0.7
    rows, columns = np.nonzero(known)
    shift = np.rint(pair.disparity[known]).astype(int)

    def difference(offset: int) -> float:
        there = columns - shift - offset
        inside = (there >= 0) & (there < width)
        left = pair.left[rows[inside], columns[inside]].astype(int)
        right = pair.right[rows[inside], there[inside]].astype(int)
        return float(np.abs(left - right).mean())

    nearest = min(range(-8, 9), key=difference)
    assert abs(nearest) <= 1


def test_what_is_missing_or_wrong_is_named(scene: Path) -> None:
    calibration, good = scene / "calib.json", '"file": "disparity.png", "value_per_pixel": 4'
    for text in (
        "{}",
        "[" * 100_000,
        '{"ground_truth": {"file": "disparity.png"}}',
        f'{{"ground_truth": {{{good}, "unknown": null}}}}',
        f'{{"ground_truth": {{{good}{"0" * 400}, "unknown": 0}}}}',
        f'{{"ground_truth": {{{good}, "unknown": 0, "file": "no.png"}}}}',
        f'{{"ground_truth": {{{good}e-400, "unknown": 0}}}}',
    ):
        calibration.write_text(text)
        with pytest.raises(ImageError):
            load_middlebury(scene)
    calibration.write_text(f'{{"ground_truth": {{{good}, "unknown": 0}}}}')
    truth = scene / "disparity.png"
    content = bytearray(truth.read_bytes())
    content[content.index(b"IEND") - 5] ^= 1  # the last byte of the pixels' checksum
    truth.write_bytes(content)
    with pytest.raises(ImageError, match=r"disparity\.png"):
        load_middlebury(scene)
    Image.fromarray(np.zeros((20, 30, 3), np.uint8)).save(truth)
    with pytest.raises(ImageError):
        load_middlebury(scene)
    with pytest.raises(ImageError):
        load_middlebury(scene / "left.png")
    calibration.unlink()
    with pytest.raises(ImageError):
        load_middlebury(scene)
    Image.fromarray(np.zeros((16, 30, 3), np.uint8)).save(scene / "right.png")
    with pytest.raises(ImageError):
        load_middlebury(scene)


def test_a_calibrated_pair_may_lack_the_ground_truth(scene: Path) -> None:
    (scene / "calib.json").write_text('{"focal_px": 30.0, "baseline_mm": 160.0}')
    pair = load_calibrated_pair(scene)
    assert pair.name == scene.name
    assert pair.calibration.camera0.focal_px == (30.0, 30.0)
    assert pair.calibration.baseline_mm == 160.0
    assert np.isnan(pair.disparity).all()
    assert pair.disparity.shape == pair.left.shape[:2]
    (scene / "calib.json").unlink()
    with pytest.raises(ReconstructionError, match=r"calib\.json"):
        load_calibrated_pair(scene)
