from __future__ import annotations

import csv
import json
import subprocess
import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("webdataset", reason="needs webdataset, of the extra data")

import itertools

from deepdetect import DeepDetectError, ImageError, OptionError
from deepdetect.image import luma
from deepdetect.labels import LabelOptions, fuse
from deepdetect.training.batches import Batches
from deepdetect.training.cluster import Place
from deepdetect.training.recipe import Schedule, Stage, TrainingOptions
from deepdetect.training.shards import ShardFeed, Shards, write_shards
from deepdetect.training.shards.reading import held_examples
from deepdetect.training.views import render

OPTIONS = TrainingOptions(
    stages=(Stage(64, 2, 3), Stage(96, 2, 2)),
    short_sides=(96, 64),
    detectors=("fast", "harris", "sobel"),
    held_out=0.2,
)


@pytest.fixture(scope="module")
def shards(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> Shards:
    folder = tmp_path_factory.mktemp("shards")
    return write_shards(photographs, folder, OPTIONS, photos_a_shard=2, workers=1)


@pytest.fixture(scope="module")
def feed(shards: Shards) -> ShardFeed:
    return ShardFeed(shards, OPTIONS)


def names(feed: ShardFeed, number: int, first: int = 0) -> list[str]:
    return [example.photo.path.name for example in feed.epoch(number, first)]


def test_every_photograph_is_in_one_place(
    photographs: Path, shards: Shards, feed: ShardFeed
) -> None:
    held = [example.photo.path.name for example in held_examples(shards, OPTIONS)]
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
    from deepdetect.training.shards.reading import read_shard

    shard_of = {
        example.photo.path.name: path
        for path, _ in shards.training
        for example in read_shard(path, OPTIONS)
    }
    order = [shard_of[name] for name in names(feed, 0)]
    changes = sum(a != b for a, b in itertools.pairwise(order))
    assert changes > len(shards.training)


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
    parts = [Batches(feed, schedule, Place(rank, 2, rank, 2)).stream(0) for rank in range(2)]
    for (images, _), *halves in zip(whole, *parts, strict=True):
        np.testing.assert_array_equal(images, np.concatenate([half[0] for half in halves]))


def test_the_same_photographs_give_the_same_files(
    photographs: Path, shards: Shards, tmp_path: Path
) -> None:
    again = write_shards(photographs, tmp_path, OPTIONS, photos_a_shard=2, workers=1)
    for (first, _), (second, _) in zip(shards.training, again.training, strict=True):
        assert first.read_bytes() == second.read_bytes()


def test_a_broken_off_call_goes_on(photographs: Path, tmp_path: Path) -> None:
    made = write_shards(photographs, tmp_path, OPTIONS, photos_a_shard=2, workers=1)
    kept, lost = made.training[0][0], made.training[1][0]
    content, written = lost.read_bytes(), kept.stat().st_mtime_ns
    lost.unlink()
    (tmp_path / "shards.json").unlink()
    write_shards(photographs, tmp_path, OPTIONS, photos_a_shard=2, workers=1)
    assert lost.read_bytes() == content
    assert kept.stat().st_mtime_ns == written


def test_other_options_are_refused(photographs: Path, shards: Shards) -> None:
    other = TrainingOptions(stages=OPTIONS.stages, short_sides=(96,), detectors=("fast",))
    with pytest.raises(OptionError, match="short_sides, held_out, labels"):
        Shards.open(shards.folder, other)
    with pytest.raises(OptionError, match="another folder with -o"):
        write_shards(photographs, shards.folder, other)


def test_an_unreadable_photograph_leaves_no_half_shard(photographs: Path, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for path in sorted(photographs.iterdir())[:6]:
        (folder / path.name).write_bytes(path.read_bytes())
    (folder / "photo99.png").write_bytes(b"no image")
    with pytest.raises(DeepDetectError, match=r"photo99\.png is not an image"):
        write_shards(folder, tmp_path / "out", OPTIONS, photos_a_shard=2, workers=1)
    left = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert "shards.json" not in left
    for name in left:
        assert name.endswith((".tar", "plan.json")), name
        if name.endswith(".tar"):
            with tarfile.open(tmp_path / "out" / name) as tar:
                assert tar.getmembers()
    (folder / "photo99.png").unlink()
    with pytest.raises(OptionError, match="other photographs"):
        write_shards(folder, tmp_path / "out", OPTIONS, photos_a_shard=2, workers=1)


@pytest.mark.parametrize("damage", ["cut", "missing", "fewer", "index"])
def test_damaged_shards_are_told(damage: str, photographs: Path, tmp_path: Path) -> None:
    made = write_shards(photographs, tmp_path, OPTIONS, photos_a_shard=4, workers=1)
    path = made.training[0][0]
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:5000])
    elif damage == "missing":
        path.unlink()
    elif damage == "fewer":
        path.write_bytes(made.training[-1][0].read_bytes())
        other = made.validation[0][0] if made.training[-1][1] == made.training[0][1] else None
        if other is not None:
            path.write_bytes(other.read_bytes())
    else:
        (tmp_path / "shards.json").write_text("{")
    with pytest.raises(ImageError, match="deepdetect shards"):
        list(ShardFeed(Shards.open(tmp_path, OPTIONS), OPTIONS).epoch(0))


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
        [*program, "shards", str(photographs), "-o", shards, "--photos-a-shard", "3", *same],
        check=True,
        capture_output=True,
        text=True,
    )
    counts = json.loads(made.stdout)
    assert counts["training"] + counts["validation"] == 12
    tiny = ["--stage", "64x4x4", "--validations", "2", "--no-compile", "--precision", "float32"]
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
