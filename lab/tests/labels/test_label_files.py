from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepdetect import OptionError
from deepdetect.io.image import luma
from deepdetect.io.masks import load_mask
from deepdetect_lab.labels import LabelOptions, fuse
from deepdetect_lab.labels.fusion import LabelTask, label_file

FAST = LabelOptions(("fast",), "normal")
SOBEL = LabelOptions(("sobel",), "normal")


@pytest.fixture
def image(photo: np.ndarray, tmp_path: Path) -> Path:
    Image.fromarray(photo[:60, :80]).save(tmp_path / "photo.png")
    return tmp_path / "photo.png"


def test_an_image_is_labelled_in_several_ways(
    image: Path, photo: np.ndarray, tmp_path: Path
) -> None:
    tasks = [
        LabelTask(image, tmp_path / "fast.png", FAST),
        LabelTask(image, tmp_path / "sobel.png", SOBEL, tmp_path / "figure.png"),
    ]
    for task in tasks:
        report = label_file(task)
        label = fuse(luma(photo[:60, :80]), task.options)
        assert isinstance(report, dict)
        assert (report["mask"], report["density"]) == (task.mask, label.density)
        np.testing.assert_array_equal(load_mask(task.mask), label.mask)
    assert (tmp_path / "figure.png").exists()


def test_a_bad_image_is_reported(image: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.png").write_bytes(image.read_bytes()[:100])
    paths = (tmp_path / "bad.png", image)
    tasks = [LabelTask(path, tmp_path / "masks" / path.name, FAST) for path in paths]
    bad, good = map(label_file, tasks)
    assert isinstance(bad, str)
    assert "bad.png" in bad
    assert isinstance(good, dict)
    assert [path.name for path in (tmp_path / "masks").glob("*.png")] == ["photo.png"]


def test_what_is_done_and_what_is_stale(image: Path, tmp_path: Path) -> None:
    task = LabelTask(image, tmp_path / "mask.png", FAST)
    assert task.outputs.find() is None
    label_file(task)
    assert task.outputs.find() is not None
    with pytest.raises(OptionError):
        dataclasses.replace(task, options=SOBEL).outputs.find()
    replaced = dataclasses.replace(task, options=SOBEL, overwrite=True)
    assert replaced.outputs.find() is None
    figure = dataclasses.replace(task, figure=tmp_path / "figure.png")
    assert figure.outputs.find() is None, "the figure is missing"
