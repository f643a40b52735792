from __future__ import annotations

import csv
import dataclasses
import json
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("webdataset", reason="needs webdataset, of the extra data")

import itertools

from deepdetect import DeepDetectError, ImageError, OptionError
from deepdetect.io.image import luma
from deepdetect.labels import LabelOptions, fuse
from deepdetect.training.batches import Batches
from deepdetect.training.cluster import DistributedContext
from deepdetect.training.preparation import Sources, prepare
from deepdetect.training.recipe import Stage, TrainingOptions
from deepdetect.training.schedule import Schedule
from deepdetect.training.shards import HeldExamples, ShardFeed, Shards, has_shards, write_shards
from deepdetect.training.shards.reading import read_shard
from deepdetect.training.views import render

OPTIONS = TrainingOptions(
    stages=(Stage(64, 2, 3), Stage(96, 2, 2)),
    short_sides=(96, 64),
    augmentations=1,
    detectors=("fast", "harris", "sobel"),
    val_fraction=0.2,
)


@pytest.fixture(scope="module")
def shards(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> Shards:
    folder = tmp_path_factory.mktemp("shards")
    return write_shards(photographs, folder, OPTIONS, shard_size=2, workers=1)


@pytest.fixture(scope="module")
def feed(shards: Shards) -> ShardFeed:
    return ShardFeed(shards, OPTIONS)


def names(feed: ShardFeed, number: int, first: int = 0) -> list[str]:
    return [example.photo.path.name for example in feed.epoch(number, first)]


def test_every_photograph_is_in_one_place(
    photographs: Path, shards: Shards, feed: ShardFeed
) -> None:
    held = [example.photo.path.name for example in HeldExamples(shards, OPTIONS)]
    assert held
    assert len(feed) == len(names(feed, 0))
    assert sorted(held + names(feed, 0)) == sorted(path.name for path in photographs.iterdir())


def test_each_epoch_has_an_order_of_its_own_from_any_place(feed: ShardFeed) -> None:
    orders = [names(feed, number) for number in range(3)]
    assert len({tuple(order) for order in orders}) == 3
    assert names(feed, 1) == orders[1]
    for first in range(len(feed) + 1):
        assert names(feed, 1, first) == orders[1][first:]


def test_shards_are_mixed_and_not_only_ordered(feed: ShardFeed, shards: Shards) -> None:
    """Photographs of one shard need not follow each other."""
    shard_of = {
        example.photo.path.name: path
        for path, count in shards.training
        for example in read_shard(path, count, OPTIONS)
    }
    order = [shard_of[name] for name in names(feed, 0)]
    changes = sum(a != b for a, b in itertools.pairwise(order))
    assert changes > len(shards.training) - 1


def test_views_and_labels_are_those_of_the_photographs(photographs: Path, feed: ShardFeed) -> None:
    for example in feed.epoch(0):
        path = photographs / example.photo.path
        for view in example.photo.normal + example.photo.dark:
            image, mask = example.load(view)
            np.testing.assert_array_equal(image, render(path, view))
            visibility = "normal" if view.darkening is None else "low"
            expected = fuse(luma(image), LabelOptions(OPTIONS.detectors, visibility)).mask
            np.testing.assert_array_equal(mask, expected)


def test_batches_are_a_pure_function_of_the_step_and_shared_by_processes(feed: ShardFeed) -> None:
    schedule = Schedule(OPTIONS, len(feed))
    whole = list(Batches(feed, schedule).stream(0))
    assert len(whole) == schedule.steps
    for step, (images, masks) in enumerate(Batches(feed, schedule).stream(4), start=4):
        np.testing.assert_array_equal(images, whole[step][0])
        np.testing.assert_array_equal(masks, whole[step][1])
    parts = [
        Batches(feed, schedule, DistributedContext(rank, 2, rank, 2)).stream(0) for rank in range(2)
    ]
    for (images, _), *halves in zip(whole, *parts, strict=True):
        np.testing.assert_array_equal(images, np.concatenate([half[0] for half in halves]))


def test_the_same_photographs_give_the_same_files(
    photographs: Path, shards: Shards, tmp_path: Path
) -> None:
    again = write_shards(photographs, tmp_path, OPTIONS, shard_size=2, workers=1)
    for (first, _), (second, _) in zip(shards.training, again.training, strict=True):
        assert first.read_bytes() == second.read_bytes()


def test_a_broken_off_call_goes_on(photographs: Path, tmp_path: Path) -> None:
    made = write_shards(photographs, tmp_path, OPTIONS, shard_size=2, workers=1)
    kept, lost = made.training[0][0], made.training[1][0]
    content, written = lost.read_bytes(), kept.stat().st_mtime_ns
    lost.unlink()
    (tmp_path / "shards.json").unlink()
    with pytest.raises(ImageError, match="not finished"):
        has_shards(tmp_path)
    write_shards(photographs, tmp_path, OPTIONS, shard_size=2, workers=1)
    assert has_shards(tmp_path)
    assert lost.read_bytes() == content
    assert kept.stat().st_mtime_ns == written


def test_shards_of_an_older_version_are_those_without_variations(
    photographs: Path, tmp_path: Path
) -> None:
    options = dataclasses.replace(OPTIONS, augmentations=0, detectors=("fast",))
    write_shards(photographs, tmp_path, options, shard_size=6, workers=1)
    path = tmp_path / "shards.json"
    index = json.loads(path.read_text())
    del index["options"]["augmentations"]
    path.write_text(json.dumps(index))
    assert Shards.open(tmp_path, options).training
    with pytest.raises(OptionError, match="augmentations"):
        Shards.open(tmp_path, dataclasses.replace(options, augmentations=1))


def test_other_options_are_refused(photographs: Path, shards: Shards) -> None:
    other = TrainingOptions(stages=OPTIONS.stages, short_sides=(96,), detectors=("fast",))
    with pytest.raises(OptionError, match="short_sides, val_fraction, augmentations, labels"):
        Shards.open(shards.folder, other)
    with pytest.raises(OptionError, match="another folder"):
        write_shards(photographs, shards.folder, other)
    with pytest.raises(OptionError, match="holds the photographs"):
        write_shards(photographs, photographs, OPTIONS)


def test_other_packing_is_another_set(photographs: Path, shards: Shards, tmp_path: Path) -> None:
    """The order of the photographs depends on it, so a run must not go on with it."""
    other = write_shards(photographs, tmp_path, OPTIONS, shard_size=3, workers=1)
    assert other.digest != shards.digest


def copies(photographs: Path, folder: Path) -> Path:
    folder.mkdir()
    for path in photographs.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    return folder


def test_an_unreadable_photograph_can_be_mended(photographs: Path, tmp_path: Path) -> None:
    folder, output = copies(photographs, tmp_path / "photos"), tmp_path / "out"
    bad = folder / "photo05.png"
    bad.write_bytes(b"no image")
    with pytest.raises(DeepDetectError, match=r"1 of \d shards .*photo05\.png is not an image"):
        write_shards(folder, output, OPTIONS, shard_size=2, workers=1)
    left = {path: path.stat().st_mtime_ns for path in output.iterdir()}
    assert left
    for path in left:
        with tarfile.open(path) as tar:
            assert tar.getmembers(), "only whole shards are there"
    bad.write_bytes((folder / "photo06.png").read_bytes())
    made = write_shards(folder, output, OPTIONS, shard_size=2, workers=1)
    for path, written in left.items():
        assert path.stat().st_mtime_ns == written, "what was done is not done again"
    assert len(made.training) + len(made.validation) == len(left) + 1


def test_few_shards_change_when_a_photograph_goes(photographs: Path, tmp_path: Path) -> None:
    folder = copies(photographs, tmp_path / "photos")
    before = write_shards(folder, tmp_path / "out", OPTIONS, shard_size=2, workers=1)
    (folder / next(iter(ShardFeed(before, OPTIONS).epoch(0))).photo.path).unlink()
    after = write_shards(folder, tmp_path / "out", OPTIONS, shard_size=2, workers=1)
    assert len(set(before.training) - set(after.training)) == 1


@pytest.mark.parametrize("kind", ["training", "validation"])
@pytest.mark.parametrize("damage", ["cut", "missing", "other", "index"])
def test_damaged_shards_are_told(
    damage: str, kind: str, photographs: Path, shards: Shards, tmp_path: Path
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(shards.folder, folder)
    path = folder / getattr(shards, kind)[0][0].name
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:5000])
    elif damage == "missing":
        path.unlink()
    elif damage == "other":  # ends between two photographs
        with tarfile.open(path, "w"):
            pass
    else:
        (folder / "shards.json").write_text("{")
    with pytest.raises(ImageError, match="deepdetect shards"):
        read_all(folder, kind)


def read_all(folder: Path, kind: str) -> None:
    found = Shards.open(folder, OPTIONS)
    if kind == "training":
        list(ShardFeed(found, OPTIONS).epoch(0))
    else:
        list(HeldExamples(found, OPTIONS))


def test_a_damaged_photograph_is_named(feed: ShardFeed) -> None:
    example = next(iter(feed.epoch(0)))
    view = example.photo.normal[0]
    broken = dataclasses.replace(example, content=example.content[:200])
    with pytest.raises(ImageError, match=f"{example.shard.name} .*{example.photo.path}"):
        broken.load(view)
    with pytest.raises(ImageError, match=f"{example.shard.name} .*{example.photo.path}"):
        dataclasses.replace(example, labels={}).load(view)


def test_validation_can_come_from_a_folder(
    photographs: Path, shards: Shards, tmp_path: Path
) -> None:
    made = prepare(Sources(shards.folder, tmp_path, photographs), OPTIONS, workers=1)
    assert len(list(made.held)) == 12
    own = prepare(Sources(shards.folder, tmp_path), OPTIONS, workers=1)
    assert len(list(own.held)) == sum(count for _, count in shards.validation)
    assert made.digest != own.digest
    for example in own.held:
        image, mask = example.load(example.photo.dark[0])
        assert mask.shape == image.shape[:2]


def test_the_two_commands(photographs: Path, tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="needs torch, which is for training only")
    same = [
        "--short-side",
        "96",
        "--short-side",
        "64",
        "--detectors",
        "fast,sobel",
        "--json",
        "--workers",
        "1",
    ]
    program = [sys.executable, "-m", "deepdetect"]
    shards, run = str(tmp_path / "shards"), tmp_path / "run"
    made = subprocess.run(
        [*program, "shards", str(photographs), "-o", shards, "--shard-size", "3", *same],
        check=True,
        capture_output=True,
        text=True,
    )
    counts = json.loads(made.stdout)
    assert counts["training"] + counts["validation"] == 12
    tiny = ["--stage", "64x4x4", "--val-count", "2", "--no-compile", "--precision", "float32"]
    command = [*program, "train", shards, "-o", str(run), *same, *tiny, "--threads", "1"]
    subprocess.run(command, check=True, capture_output=True)
    rows = list(csv.DictReader((run / "curves.csv").read_text().splitlines()))
    assert len(rows) == 2
    assert float(rows[-1]["images"]) == counts["training"] * 4 // 4 * 4
    done = subprocess.run(
        [*command, "--short-side", "64"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "deepdetect shards and deepdetect train the same" in done.stderr
    assert "Traceback" not in done.stderr
