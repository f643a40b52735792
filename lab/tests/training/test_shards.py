from __future__ import annotations

import json
import shutil
import tarfile
from pathlib import Path

import numpy as np
import pytest
import webdataset

from deepdetect import ImageError, OptionError
from deepdetect._shared.errors import BatchError
from deepdetect.io.image import luma
from deepdetect_lab.labels import LabelOptions, fuse
from deepdetect_lab.training.recipe import Stage, TrainingOptions
from deepdetect_lab.training.shards import Shards, ShardSource, write_shards
from deepdetect_lab.training.views import render

OPTIONS = TrainingOptions(
    stages=(Stage(64, 2, 3), Stage(96, 2, 2)),
    short_sides=(96, 64),
    augmentations=1,
    labels=LabelOptions(("fast", "harris", "sobel")),
    val_fraction=0.2,
)


@pytest.fixture(scope="module")
def shards(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> Shards:
    folder = tmp_path_factory.mktemp("shards")
    return write_shards(photographs, folder, OPTIONS, shard_size=2, workers=1)


@pytest.fixture(scope="module")
def source(shards: Shards) -> ShardSource:
    return ShardSource(shards.training, OPTIONS)


def names(source: ShardSource) -> list[str]:
    return [source[index].path.name for index in range(len(source))]


def test_every_image_is_in_one_place(
    photographs: Path, shards: Shards, source: ShardSource
) -> None:
    held_out = names(ShardSource(shards.validation, OPTIONS))
    assert held_out
    assert len(source) == sum(count for _, count in shards.training)
    assert sorted(held_out + names(source)) == sorted(p.name for p in photographs.iterdir())


def test_webdataset_reads_the_same(shards: Shards, source: ShardSource) -> None:
    """The layout is that of WebDataset, so other programs can read the shards."""
    index = 0
    for path, _ in shards.training:
        with path.open("rb") as file:
            files = webdataset.tariterators.tar_file_expander([{"url": str(path), "stream": file}])
            for sample in webdataset.tariterators.group_by_keys(files):
                assert sample["name.txt"].decode() == source[index].path.as_posix()
                (content,) = (v for k, v in sample.items() if k.startswith("image."))
                view = source[index].dark[0]
                np.testing.assert_array_equal(render(content, view), source.load(index, view)[0])
                assert f"label.{view.name}.png" in sample
                index += 1
    assert index == len(source)


def test_views_and_labels_are_those_of_the_images(photographs: Path, source: ShardSource) -> None:
    for index in range(len(source)):
        path = photographs / source[index].path
        for view in source[index].normal + source[index].dark:
            image, mask = source.load(index, view)
            np.testing.assert_array_equal(image, render(path, view))
            visibility = "normal" if view.darkening is None else "low"
            expected = fuse(luma(image), LabelOptions(OPTIONS.labels.detectors, visibility)).mask
            np.testing.assert_array_equal(mask, expected)


def test_a_broken_off_call_goes_on(photographs: Path, tmp_path: Path) -> None:
    made = write_shards(photographs, tmp_path, OPTIONS, shard_size=2, workers=1)
    kept, lost = made.training[0][0], made.training[1][0]
    content, written = lost.read_bytes(), kept.stat().st_mtime_ns
    lost.unlink()
    (tmp_path / "shards.json").unlink()
    with pytest.raises(ImageError):
        Shards.open(tmp_path, OPTIONS)
    write_shards(photographs, tmp_path, OPTIONS, shard_size=2, workers=1)
    assert Shards.open(tmp_path, OPTIONS) == made
    assert lost.read_bytes() == content
    assert kept.stat().st_mtime_ns == written


def test_other_options_are_refused(photographs: Path, shards: Shards) -> None:
    other = TrainingOptions(
        stages=OPTIONS.stages, short_sides=(96,), labels=LabelOptions(("fast",))
    )
    with pytest.raises(OptionError, match="`short_sides`"):
        Shards.open(shards.folder, other)
    with pytest.raises(OptionError):
        write_shards(photographs, shards.folder, other)
    with pytest.raises(OptionError):
        write_shards(photographs, photographs, OPTIONS)


def test_an_unreadable_photograph_can_be_mended(photographs: Path, tmp_path: Path) -> None:
    folder, output = tmp_path / "photos", tmp_path / "out"
    shutil.copytree(photographs, folder)
    bad = folder / "photo05.png"
    content = bad.read_bytes()
    bad.write_bytes(b"no image")
    with pytest.raises(BatchError, match=r"photo05\.png"):
        write_shards(folder, output, OPTIONS, shard_size=2, workers=1)
    left = {path: path.stat().st_mtime_ns for path in output.iterdir()}
    assert left
    for path in left:
        with tarfile.open(path) as tar:
            assert tar.getmembers(), "only whole shards are there"
    bad.write_bytes(content)
    made = write_shards(folder, output, OPTIONS, shard_size=2, workers=1)
    for path, written in left.items():
        assert path.stat().st_mtime_ns == written, "what was done is not done again"
    assert len(made.training) + len(made.validation) == len(left) + 1


@pytest.mark.parametrize("damage", ["cut", "missing", "other", "{", "[1]", "[" * 100_000])
def test_damaged_shards_are_told(damage: str, shards: Shards, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(shards.folder, folder)
    path = folder / shards.training[0][0].name
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:5000])
    elif damage == "missing":
        path.unlink()
    elif damage == "other":  # ends between two photographs
        with tarfile.open(path, "w"):
            pass
    else:
        (folder / "shards.json").write_text(damage)
    with pytest.raises(ImageError):
        read_first(folder)


def read_first(folder: Path) -> None:
    source = ShardSource(Shards.open(folder, OPTIONS).training, OPTIONS)
    source.load(0, source[0].normal[0])


def test_a_damaged_image_is_named(shards: Shards, source: ShardSource, tmp_path: Path) -> None:
    path, count = shards.training[0]
    for change in ("image", "label"):
        copy = tmp_path / f"{change}.tar"
        with tarfile.open(path) as old, tarfile.open(copy, "w") as new:
            for member in old:
                data = old.extractfile(member)
                if f".{change}." in member.name:
                    member.size = 200 if change == "image" else 0
                new.addfile(member, data)
        damaged = ShardSource(((copy, count),), OPTIONS)
        name = source[0].path.name
        with pytest.raises(ImageError, match=f"{copy.name}.*{name}"):
            damaged.load(0, source[0].normal[0])


def test_an_index_cannot_name_files_elsewhere(shards: Shards, tmp_path: Path) -> None:
    shutil.copytree(shards.folder, tmp_path / "copy")
    path = tmp_path / "copy" / "shards.json"
    index = json.loads(path.read_text())
    index["training"][0]["file"] = "/etc/passwd"
    path.write_text(json.dumps(index))
    with pytest.raises(ImageError):
        Shards.open(tmp_path / "copy", OPTIONS)
