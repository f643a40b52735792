from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepdetect.io.image import luma
from deepdetect.io.masks import load_mask
from deepdetect.labels import LabelOptions, fuse
from deepdetect.labels.batch import LabelTarget, LabelTask, label_files, unfinished_tasks

FAST = LabelOptions(("fast",), "normal")
SOBEL = LabelOptions(("sobel",), "normal")


@pytest.fixture
def image(photo: np.ndarray, tmp_path: Path) -> Path:
    Image.fromarray(photo[:60, :80]).save(tmp_path / "photo.png")
    return tmp_path / "photo.png"


def test_an_image_is_labelled_in_several_ways(
    image: Path, photo: np.ndarray, tmp_path: Path
) -> None:
    targets = (
        LabelTarget(tmp_path / "fast.png", FAST),
        LabelTarget(tmp_path / "sobel.png", SOBEL, tmp_path / "figure.png"),
        LabelTarget(tmp_path / "flipped.png", FAST, transform=partial(np.flip, axis=1)),
    )
    seen = []
    reports = label_files([LabelTask(image, targets)], workers=1, callback=seen.append)
    assert seen == reports
    gray = luma(photo[:60, :80])
    expected = [fuse(gray, FAST), fuse(gray, SOBEL), fuse(gray[:, ::-1].copy(), FAST)]
    for target, report, label in zip(targets, reports, expected, strict=True):
        assert (report.mask, report.density) == (target.mask, label.density)
        np.testing.assert_array_equal(load_mask(target.mask), label.mask)
    assert (tmp_path / "figure.png").exists()


def test_a_bad_image_is_reported(image: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.png").write_bytes(image.read_bytes()[:100])
    tasks = [
        LabelTask(path, (LabelTarget(tmp_path / "masks" / path.name, FAST),))
        for path in (tmp_path / "bad.png", image)
    ]
    bad, good = label_files(tasks, workers=1)
    assert "bad.png" in str(bad.error)
    assert np.isnan(bad.density)
    assert good.error is None
    assert [path.name for path in (tmp_path / "masks").iterdir()] == ["photo.png"]


def test_what_is_done_and_what_is_stale(image: Path, tmp_path: Path) -> None:
    fast, sobel = (tmp_path / f"{name}.png" for name in ("fast", "sobel"))
    task = LabelTask(image, (LabelTarget(fast, FAST), LabelTarget(sobel, SOBEL)))
    label_files([task], workers=1)
    assert unfinished_tasks([task]) == []
    sobel.unlink()
    assert unfinished_tasks([task]) == [LabelTask(image, task.targets[1:])]
    assert not LabelTarget(fast, FAST).is_stale
    assert LabelTarget(fast, SOBEL).is_stale
    assert not LabelTarget(sobel, FAST).is_stale  # it does not exist
    with_figure = LabelTask(image, (LabelTarget(fast, FAST, tmp_path / "figure.png"),))
    assert unfinished_tasks([with_figure]) == [with_figure]
