from __future__ import annotations

import dataclasses
import multiprocessing
import pickle
import shutil
from collections.abc import Iterable
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from torch import Tensor
from torch.utils.data import DataLoader

from deepdetect import DeepDetectError, ImageError
from deepdetect.io.image import luma
from deepdetect.io.masks import load_mask, save_mask
from deepdetect_lab.labels import LabelOptions, fuse
from deepdetect_lab.training.dataset import (
    CropDataset,
    FolderSource,
    ValidationDataset,
    loading,
    prepare_data,
)
from deepdetect_lab.training.recipe import Stage, TrainingOptions
from deepdetect_lab.training.sampler import Schedule
from deepdetect_lab.training.views import (
    SourceImage,
    View,
    label_key,
    label_view,
    list_images,
    render,
)

from .conftest import plain_options

OPTIONS = plain_options(
    stages=(Stage(64, 4, 6), Stage(96, 2, 1)),
    short_sides=(96, 64),
    transpositions=True,
    color_jitter=0.0,
    augmentations=1,
    labels=LabelOptions(("fast", "harris", "sobel")),
)

Batch = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def source(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> FolderSource:
    folder, images = tmp_path_factory.mktemp("labels"), list_images(photographs, OPTIONS)
    for count, expected in ((3, 3 * 6), (12, 9 * 6)):
        made = FolderSource(images[:count], folder, OPTIONS.labels, 2**30)
        views = [image.normal + image.dark for image in made.images]
        assert made.make_labels(views, workers=1) == expected, "labels are made once"
    return made


def label(source: FolderSource, image: SourceImage, view: View) -> np.ndarray:
    return load_mask(source.label_path(image, view))


def test_labels_are_those_of_the_views(source: FolderSource) -> None:
    image = source.images[0]
    for view in image.normal + image.dark:
        rgb = render(image.path, view)
        visibility = "normal" if view.darkening is None else "low"
        expected = fuse(luma(rgb), LabelOptions(OPTIONS.labels.detectors, visibility)).mask
        np.testing.assert_array_equal(label(source, image, view), expected)
        np.testing.assert_array_equal(label_view(rgb, view, OPTIONS.labels), expected)


def test_other_settings_have_another_folder() -> None:
    keys = {label_key(LabelOptions(names)) for names in (("fast",), ("fast", "sobel"))}
    assert len(keys) == 2
    assert label_key(LabelOptions(("fast",), "low")) in keys, "views decide that"


def test_an_image_that_cannot_be_read_is_named(photographs: Path, tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes((photographs / "photo00.png").read_bytes())
    (tmp_path / "broken.png").write_bytes(b"no image")
    made = FolderSource(list_images(tmp_path, OPTIONS), tmp_path / "labels", OPTIONS.labels)
    with pytest.raises(DeepDetectError, match=r"broken\.png"):
        made.make_labels([image.normal[:2] for image in made.images], workers=1)
    assert len(list(made.label_folder.glob("*.png"))) == 2 * 2, "the others are kept"


def loader(
    source, options: TrainingOptions = OPTIONS, workers: int = 0, first: int = 0
) -> DataLoader:
    batches = Schedule(options, len(source)).batches(first)
    return DataLoader(CropDataset(source, options), batch_sampler=batches, num_workers=workers)


def batches(source, options: TrainingOptions = OPTIONS, first: int = 0, last=None) -> list[Batch]:
    made = loader(source, options, first=first)
    count = None if last is None else last - first
    return [(images.numpy(), masks.numpy()) for images, masks in islice(made, count)]


def same(found: Iterable[Batch], expected: Iterable[Batch]) -> None:
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours[0], theirs[0])
        np.testing.assert_array_equal(ours[1], theirs[1])


def again(source: FolderSource, memory_bytes: int = 0) -> FolderSource:
    """A source reads the same images and labels, but keeps nothing in memory."""
    folder = source.label_folder.parent
    return FolderSource(source.images, folder, OPTIONS.labels, memory_bytes)


def all_views(source: FolderSource) -> list[Batch]:
    return [
        (render(image.path, view), label(source, image, view))
        for image in source.images
        for view in image.normal + image.dark
    ]


def test_a_batch_is_a_pure_function_of_the_step(source: FolderSource) -> None:
    whole = batches(source)
    assert len(whole) == 12 * 6 // 4 + 12 // 2
    fresh = again(source)
    for first, last in ((7, 8), (0, 1), (5, None)):
        same(batches(fresh, first=first, last=last), whole[first:last])
    assert not np.array_equal(whole[0][0], whole[1][0])


def test_crops_and_labels_belong_together(source: FolderSource) -> None:
    """Each crop lies in one of the views, and its mask at the same place of the view's label."""
    views = all_views(source)
    for image, mask in zip(*batches(source, first=2, last=3)[0], strict=True):
        assert any(_found(image, mask, *view) for view in views)


def _found(image: np.ndarray, mask: np.ndarray, view: np.ndarray, label: np.ndarray) -> bool:
    side = len(image)
    for flipped, flipped_mask in ((image, mask), (image.transpose(1, 0, 2), mask.T)):
        corner = (view[: len(view) - side + 1, : view.shape[1] - side + 1] == flipped[0, 0]).all(2)
        for top, left in np.argwhere(corner):
            place = np.s_[top : top + side, left : left + side]
            if np.array_equal(view[place], flipped) and np.array_equal(label[place], flipped_mask):
                return True
    return False


class Corners:
    """One image for all views, with another value at each corner."""

    def __len__(self) -> int:
        return 12

    def __getitem__(self, index: int) -> SourceImage:
        return SourceImage(Path("corners.png"), "", (View(64),), ())

    def load(self, index: int, view: View) -> tuple[np.ndarray, np.ndarray]:
        image = np.zeros((64, 64, 3), np.uint8)
        image[0, 0], image[0, -1], image[-1, 0] = 1, 2, 3
        return image, image[..., 0] > 0


@pytest.mark.parametrize(("transpositions", "count"), [(False, 1), (True, 2)])
def test_crops_are_transposed_when_asked_for(transpositions: bool, count: int) -> None:
    """Crops of an image that every mirror changes."""
    options = plain_options(
        stages=(Stage(64, 4, 60),),
        short_sides=(64,),
        dark_fraction=0.0,
        transpositions=transpositions,
    )
    seen = set()
    for images, masks in batches(Corners(), options, last=40):
        np.testing.assert_array_equal(masks, images[..., 0] > 0)
        seen |= {tuple(i[[0, 0, -1, -1], [0, -1, 0, -1], 0].tolist()) for i in images}
    assert len(seen) == count


@pytest.mark.parametrize(("dark", "levels", "grays"), [(0.0, 1, range(5, 16)), (1.0, 0, [16])])
def test_colors_change_and_labels_do_not(
    source: FolderSource, dark: float, levels: int, grays: Iterable[int]
) -> None:
    """Dark crops keep their luma to the level, so they become grey."""
    plain, colored = (
        dataclasses.replace(OPTIONS, dark_fraction=dark, color_jitter=share) for share in (0, 1)
    )
    gray = 0
    for (images, masks), (others, same_masks) in zip(
        batches(source, plain, last=4), batches(source, colored, last=4), strict=True
    ):
        np.testing.assert_array_equal(masks, same_masks)
        for image, other in zip(images, others, strict=True):
            assert np.abs(luma(other).astype(int) - luma(image)).max() <= levels
            gray += int((other == other[..., :1]).all())
    assert gray in grays


@pytest.mark.parametrize("dark", [0, 1])
def test_noise_of_a_sensor_changes_dark_images_and_no_labels(
    source: FolderSource, dark: int
) -> None:
    options = dataclasses.replace(OPTIONS, dark_fraction=dark)
    plain, noisy = (dataclasses.replace(options, sensor_noise=share) for share in (0, 1))
    sigmas = []
    for (images, masks), (others, same_masks) in zip(
        batches(source, plain, last=8), batches(source, noisy, last=8), strict=True
    ):
        np.testing.assert_array_equal(masks, same_masks)
        sigmas += [np.std(b.astype(float) - a) for a, b in zip(images, others, strict=True)]
    assert (max(sigmas) == 0) if not dark else (min(sigmas) > 0.3 and 4 < max(sigmas) < 25)


def test_a_limit_of_the_memory_changes_nothing_but_the_time(source: FolderSource) -> None:
    frugal = again(source, memory_bytes=20_000)
    same(batches(frugal, last=4), batches(source, last=4))
    assert 0 < len(frugal._kept) < 3
    assert frugal.memory_bytes >= 0
    copy = pickle.loads(pickle.dumps(frugal))
    assert not copy._kept, "images are not sent to other processes"
    same(batches(copy, last=1), batches(source, last=1))


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_worker_processes_give_the_same_batches(source: FolderSource) -> None:
    threads = cv2.getNumThreads()
    with loading(loader(source, workers=2)) as made:
        if multiprocessing.get_start_method() == "fork":
            assert cv2.getNumThreads() == 1
        found = [(images.numpy(), masks.numpy()) for images, masks in islice(made, 4)]
    assert cv2.getNumThreads() == threads
    same(found, batches(source, last=4))


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
@pytest.mark.parametrize("workers", [0, 1])
def test_an_error_of_a_worker_is_one_sentence(
    source: FolderSource, tmp_path: Path, workers: int
) -> None:
    lost = FolderSource(source.images, tmp_path, OPTIONS.labels)
    before = set(multiprocessing.active_children())
    with pytest.raises(ImageError), loading(loader(lost, workers=workers)) as made:
        next(made)
    started = set(multiprocessing.active_children()) - before
    assert not started, "they end with the block, whoever holds the error"


def test_a_label_of_another_size_is_refused(photographs: Path, tmp_path: Path) -> None:
    made = FolderSource(list_images(photographs, OPTIONS), tmp_path, OPTIONS.labels)
    view = made[0].normal[0]
    save_mask(np.zeros((8, 8), bool), made.label_path(made[0], view))
    with pytest.raises(ImageError):
        made.load(0, view)


def test_validation_is_whole_images_first_normal_then_dark(source: FolderSource) -> None:
    whole = ValidationDataset(source)
    assert len(whole) == 24
    for index in (0, 11, 12, 23):
        image = source.images[index % 12]
        view = image.dark[0] if index >= 12 else image.normal[0]
        rgb, mask = whole[index]
        np.testing.assert_array_equal(rgb, render(image.path, view))
        np.testing.assert_array_equal(mask, label(source, image, view))
        assert isinstance(mask, Tensor)


def test_preparation_makes_only_the_labels_that_are_needed(
    photographs: Path, tmp_path: Path
) -> None:
    options = plain_options(
        stages=(Stage(64, 2, 1),),
        short_sides=(64, 96),
        labels=LabelOptions(("fast",)),
        val_fraction=0.3,
    )
    data = prepare_data(photographs, options, tmp_path, workers=1)
    names = [path.name for path in (tmp_path / "labels").rglob("*.png")]
    held_out = {data.validation[k].digest for k in range(len(data.validation))}
    assert held_out
    assert len(data.training) + len(held_out) == 12
    for name in names:
        if name.split("_")[1] in held_out:
            assert name.split("_")[2] == "64", "validation takes the first size only"
    assert len(names) == 4 * len(data.training) + 2 * len(held_out)
    image, mask = data.validation.load(0, data.validation[0].normal[0])
    assert min(image.shape[:2]) == 64
    assert mask.shape == image.shape[:2]
    again = prepare_data(photographs, options, tmp_path, validation=photographs, workers=1)
    assert len(again.validation) == len(again.training) == 12
    assert again.digest != data.digest


def test_validation_images_among_the_images_are_not_trained_on(
    photographs: Path, tmp_path: Path
) -> None:
    """Nor are pictures of the run, nor is anything of them validated on."""
    images, output = tmp_path / "images", tmp_path / "images/run"
    for name in ("00.png", "a/01.png", "val/02.png", "val/b/03.png", "run/04.png"):
        (images / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(photographs / f"photo{name[-6:]}", images / name)
    data = prepare_data(images, OPTIONS, output, validation=images / "val")
    trained, held = (
        {image.path.relative_to(images).as_posix() for image in part.images}
        for part in (data.training, data.validation)
    )
    assert trained == {"00.png", "a/01.png"}
    assert held == {"val/02.png", "val/b/03.png"}


def test_images_among_the_validation_images_are_not_validated_on(
    photographs: Path, tmp_path: Path
) -> None:
    whole = tmp_path / "photographs"
    for name in ("00.png", "train/01.png"):
        (whole / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(photographs / f"photo{name[-6:]}", whole / name)
    how = {"validation": whole}
    data = prepare_data(whole / "train", OPTIONS, tmp_path / "run", **how)
    assert [image.path for image in data.training.images] == [whole / "train/01.png"]
    assert [image.path for image in data.validation.images] == [whole / "00.png"]
