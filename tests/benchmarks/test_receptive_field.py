from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image

from deepdetect import HeatmapOptions
from deepdetect.detector.pretrained import pretrained_weights
from deepdetect.detector.tiling import REACH_PX


@pytest.fixture(scope="module")
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("receptive_field")


class Pointwise:
    """A network that sees each pixel alone."""

    def configured(self, options: HeatmapOptions) -> Pointwise:
        return Shifted(options.tile_megapixels)

    def heatmap_and_logits(self, image: np.ndarray) -> tuple[None, np.ndarray]:
        return None, image[..., 0].astype(float) - 128.5


class Shifted(Pointwise):
    """One whose logits are higher, by as much as it is told."""

    def __init__(self, by: float) -> None:
        self.by = by

    def heatmap_and_logits(self, image: np.ndarray) -> tuple[None, np.ndarray]:
        return None, super().heatmap_and_logits(image)[1] + self.by


class FromAbove(Pointwise):
    """A network that sees nothing but the border above, up to 20 px away."""

    def heatmap_and_logits(self, image: np.ndarray) -> tuple[None, np.ndarray]:
        rows = np.arange(len(image), dtype=float)[:, None]
        return None, np.where(rows < 20, -1 - rows, 1) + np.zeros(image.shape[:2])


@pytest.fixture
def image() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (200, 160, 3), np.uint8)


def test_the_reach_is_what_the_package_says(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(script, "STRIP_PX", (16, REACH_PX + 100))
    changes = script.noise_changes(pretrained_weights())
    assert changes.shape == (REACH_PX + 100,)
    assert changes[0] > 1
    assert 1000 < script.farthest(changes, 0) <= REACH_PX
    assert script.farthest(changes, 0.1) < script.farthest(changes, 0.001)


def test_the_farthest_change(script: ModuleType) -> None:
    changes = np.array([5, 0.5, 0.2, 0.3, 0.0])
    assert [script.farthest(changes, above) for above in (9, 1, 0.25, 0)] == [0, 1, 4, 4]


def test_a_shift(script: ModuleType, image: np.ndarray) -> None:
    assert script.shift_differences(Pointwise(), image).max() == 0
    differences = script.shift_differences(FromAbove(), image)
    assert differences.shape == (192,)
    # Its rows are 8 nearer to the border.
    np.testing.assert_array_equal(differences[:12], 8)
    assert differences[12:20].min() > 8
    assert differences[20:].max() == 0


def test_a_cut(script: ModuleType, image: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script, "BANDS_PX", ((0, 16), (24, 48), (60, 70)))
    nearest, farther, none = script.cut_shares(Pointwise(), image, 96)
    assert (nearest, farther) == (0, 0)
    assert np.isnan(none)
    nearest, farther, _ = script.cut_shares(FromAbove(), image, 96)
    # All keypoints of the upper 16 rows go: of the band's frame and of the rows below it.
    distance = np.minimum(np.arange(96), np.arange(96)[::-1])
    band = np.minimum(distance, distance[:, None]) < 16
    assert nearest == pytest.approx(band[:20].sum() / band.sum())
    assert farther == 0


def test_tiles(script: ModuleType, image: np.ndarray) -> None:
    table = script.tile_table(Pointwise(), image, (2.0, 3.0), rounds=1)
    keypoints = int(np.count_nonzero(image[..., 0] > 128))
    for row, size in zip(table.rows, (2, 3), strict=True):
        changed = int(np.count_nonzero((image[..., 0] <= 128) & (image[..., 0] > 128 - size)))
        assert row[:4] == (size, size, keypoints, changed)


def test_a_mosaic(script: ModuleType, photo: np.ndarray, tmp_path: Path) -> None:
    Image.fromarray(np.full((40, 60, 3), 77, np.uint8)).save(tmp_path / "a.png")
    Image.fromarray(photo).resize((480, 480)).save(tmp_path / "b.png")
    found = script.mosaic(tmp_path, 500, 1000)
    assert found.shape == (500, 1000, 3)
    assert (found[:480, :480] == 77).all()
    np.testing.assert_array_equal(found[:480, 480:960], np.asarray(Image.open(tmp_path / "b.png")))
    assert (found[:480, 960:] == 77).all()
    np.testing.assert_array_equal(found[480:, :480], found[:20, 480:960])
