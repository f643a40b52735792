"""Times of a few images, and what follows for many."""

from __future__ import annotations

from pathlib import Path

import pytest

from deepdetect import PointDetector
from deepdetect.sfm import MultiViewOptions, forecast
from deepdetect.sfm.forecast import expected_seconds
from deepdetect.sfm.stages import Stages


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder of a hundred files that are no images."""
    folder = tmp_path / "images"
    folder.mkdir()
    for number in range(100):
        (folder / f"{number}.jpg").write_bytes(b"")
    return folder


@pytest.mark.parametrize(
    ("pairs", "count"), [("exhaustive", 4950), ("sequential:10", 1000), ("auto", 1200)]
)
def test_stages_take_what_a_few_images_take(
    folder: Path, monkeypatch: pytest.MonkeyPatch, pairs: str, count: int
) -> None:
    """Two workers have measured, on a machine of half the speed of that of the constants."""
    image_s = 2 * (0.5 * forecast.MEGAPIXEL_S + 8192 * forecast.KEYPOINT_S)
    measured = [(image_s - 0.1, 0.3, 0.5, 8192), (image_s + 0.1, 0.5, 0.5, 8192)]
    monkeypatch.setattr(forecast, "map_in_processes", lambda *_: iter(measured))
    stages = Stages(folder.parent / "model", MultiViewOptions(pairs), 2, True)
    found = expected_seconds(stages, folder, PointDetector())
    assert found["features"] == pytest.approx(100 * image_s / 2)
    assert found["matching"] == pytest.approx(count * 0.4 / 2)
    later = 1 + 100 / forecast.ADJUSTED_IMAGES
    mapping = 100 * later * forecast.MAPPED_IMAGE_S + count * 8192 * forecast.PAIRED_KEYPOINT_S
    assert found["mapping"] == pytest.approx(2 * mapping)
    assert found["dense points"] == pytest.approx(2 * 50 * forecast.DENSE_MEGAPIXEL_S / 2)


def test_images_that_cannot_be_read_tell_nothing(folder: Path, pycolmap) -> None:
    stages = Stages(folder.parent / "model", MultiViewOptions(), 1, True)
    assert expected_seconds(stages, folder, PointDetector()) == {}
