"""torch datasets: random crops for training, and whole images for validation."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from deepdetect._shared.errors import BatchError, DeepDetectError, ImageError
from deepdetect._shared.machine import available_memory, map_in_processes, one_opencv_thread
from deepdetect._shared.progress import progress
from deepdetect._shared.records import key
from deepdetect.io.image import load_image
from deepdetect.io.masks import load_mask, save_mask

from ..labels import LabelOptions
from .augmentation import add_sensor_noise, jitter_color, transpose
from .recipe import Stage, TrainingOptions
from .sampler import CropIndex
from .views import (
    SourceImage,
    View,
    label_key,
    label_view,
    list_images,
    render,
    train_val_split,
)


class FolderSource:
    """Images in files, with their labels as 1-bit PNG files.

    Each choice of label settings has its own subfolder of `labels`. The name of a label file holds
    a digest of the image, so a replaced image gets a new label. Up to `memory_bytes` of views are
    kept in memory.
    """

    def __init__(
        self,
        images: Sequence[SourceImage],
        labels: Path,
        options: LabelOptions,
        memory_bytes: int = 0,
    ) -> None:
        self.images, self.label_options, self.memory_bytes = images, options, memory_bytes
        self.label_folder = labels / label_key(options)[:12]
        self._kept: dict[tuple[int, View], tuple[np.ndarray, np.ndarray]] = {}

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: int) -> SourceImage:
        return self.images[index]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_kept": {}}  # a spawned process starts without kept views

    def label_path(self, image: SourceImage, view: View) -> Path:
        """Return the path of the label file of a view."""
        return self.label_folder / f"{image.path.stem}_{image.digest}_{view.name}.png"

    def load(self, index: int, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return a view as (H, W, 3) uint8 RGB, and its label as (H, W) bool."""
        if (index, view) in self._kept:
            return self._kept[index, view]
        source = self.images[index]
        image, mask = render(source.path, view), load_mask(self.label_path(source, view))
        if mask.shape != image.shape[:2]:
            raise ImageError(
                f"the label of {source.path} does not have the size of its view: delete the "
                f"folder of labels {self.label_folder}"
            )
        if image.nbytes + mask.nbytes <= self.memory_bytes:
            self.memory_bytes -= image.nbytes + mask.nbytes
            self._kept[index, view] = image, mask
        return image, mask

    def make_labels(
        self, views: Sequence[tuple[View, ...]], workers: int | None = None, quiet: bool = True
    ) -> int:
        """Make the missing labels of each image's `views`, in parallel; return their number.

        Raises:
            BatchError: some images cannot be read. The labels of all other images are made.
        """
        tasks: list[LabelTask] = []
        for image, needed in zip(self.images, views, strict=True):
            files = {view: self.label_path(image, view) for view in needed}
            if missing := {view: path for view, path in files.items() if not path.exists()}:
                tasks.append((image.path, missing))
        total = sum(len(missing) for _, missing in tasks)
        failures: list[str] = []
        work = partial(_make_labels, options=self.label_options)
        with progress(total, "labels", "label", quiet) as bar:
            for count, failed in map_in_processes(work, tasks, workers):
                failures += failed
                bar.update(count)
        if failures:
            raise BatchError(
                f"{len(failures)} of {len(self.images)} images cannot be read (the labels of the "
                "others are kept)",
                failures,
            )
        return total


LabelTask = tuple[Path, dict[View, Path]]
"""The work on one image: its file, and the label file to write for each view."""


def _make_labels(task: LabelTask, options: LabelOptions) -> tuple[int, list[str]]:
    """Write the labels of an image; return their number, and an error if it cannot be read."""
    file, labels = task
    try:
        image = load_image(file)
        for view, path in labels.items():
            save_mask(label_view(render(image, view), view, options), path)
    except ImageError as error:
        return len(labels), [str(error)]
    return len(labels), []


class CropDataset(Dataset[tuple[Tensor, Tensor]]):
    """Random augmented crops of views, indexed by the `CropIndex` entries of a `Schedule`.

    An item is a cropped image, (crop, crop, 3) uint8 RGB, and its label, (crop, crop) bool. All
    random choices depend only on the index and the seed of the options.
    """

    def __init__(self, source: FolderSource, options: TrainingOptions) -> None:
        self.source, self.options = source, options

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, index: CropIndex) -> tuple[Tensor, Tensor]:
        options, side = self.options, index.stage.crop
        generator = np.random.default_rng([options.seed, 2, index.epoch, index.position])
        view = self._choose_view(self.source[index.image], index.stage, generator)
        image, mask = self.source.load(index.image, view)
        top = int(generator.integers(image.shape[0] - side + 1))
        left = int(generator.integers(image.shape[1] - side + 1))
        image = image[top : top + side, left : left + side]
        mask = mask[top : top + side, left : left + side]
        if options.transpositions and generator.random() < 0.5:
            image, mask = transpose(image, mask)
        dark = view.darkening is not None
        if generator.random() < options.color_jitter:
            image = jitter_color(image, generator, dark)
        if dark and generator.random() < options.sensor_noise:
            image = add_sensor_noise(image, generator)
        return torch.tensor(image), torch.tensor(mask)

    def _choose_view(
        self, image: SourceImage, stage: Stage, generator: np.random.Generator
    ) -> View:
        """Choose normal or dark light at random, then a view whose size suits the stage."""
        dark = generator.random() < self.options.dark_fraction
        fitting = [
            view
            for view in (image.dark if dark else image.normal)
            if view.short_side >= stage.crop and (not stage.sides or view.short_side in stage.sides)
        ]
        return fitting[int(generator.integers(len(fitting)))]


class ValidationDataset(Dataset[tuple[Tensor, Tensor]]):
    """Whole images, (H, W, 3) uint8 RGB, with (H, W) bool labels.

    Each image comes twice: all images in normal light come first, then all of them darkened.
    """

    def __init__(self, source: FolderSource) -> None:
        self.source = source

    def __len__(self) -> int:
        return 2 * len(self.source)

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor]:
        light, number = divmod(index, len(self.source))
        image, mask = self.source.load(number, self.source[number].validation_views[light])
        return torch.tensor(image), torch.tensor(mask)


@dataclass(frozen=True)
class TrainingData:
    """Training and validation images of a run, and a digest of all of them."""

    training: FolderSource
    validation: FolderSource
    digest: str


def prepare_data(
    images: str | Path,
    options: TrainingOptions,
    output: str | Path,
    *,
    validation: str | Path | None = None,
    labels: str | Path | None = None,
    workers: int | None = None,
    processes: int = 1,
    quiet: bool = True,
) -> TrainingData:
    """List the images of a run, and make the missing labels of their views.

    The arguments are those of `train`, and `processes`: the number of processes that load crops.
    Half of the free memory is divided among these processes, which keep training views in it.
    """
    images, output = Path(images), Path(output)
    folder = output / "labels" if labels is None else Path(labels)
    if validation is None:
        listed = list_images(images, options, (output, folder), options.max_images)
        listed, held_out = train_val_split(listed, options.val_fraction)
    else:
        others = output, folder, Path(validation)
        listed = list_images(images, options, others, options.max_images)
        held_out = list_images(Path(validation), options, (output, folder, images))
    memory = available_memory() // 2 // processes
    training = FolderSource(listed, folder, options.labels, memory)
    held = FolderSource(held_out, folder, options.labels, memory // 8)
    views = [i.normal + i.dark if options.dark_fraction > 0 else i.normal for i in listed]
    training.make_labels(views, workers, quiet)
    held.make_labels([image.validation_views for image in held_out], workers, quiet)
    digests = [[image.digest for image in part] for part in (listed, held_out)]
    return TrainingData(training, held, key(digests)[:16])


@contextlib.contextmanager
def loading(loader: DataLoader[Any]) -> Iterator[Iterator[Any]]:
    """Yield an iterator over a loader's batches, and raise errors of its processes unchanged.

    If the loader has processes, OpenCV uses one thread in this context, because a forked process
    cannot use the threads of its parent.
    """
    batches: Any = None
    try:
        with one_opencv_thread() if loader.num_workers else contextlib.nullcontext():
            batches = iter(loader)
            yield batches
    except DeepDetectError as error:
        # torch raises the error of a process again, with the whole traceback as its message.
        text = str(error).strip()
        if not text.startswith("Caught "):
            raise
        raise type(error)(text.splitlines()[-1].partition(": ")[2]) from None
    finally:
        # After an error, the traceback keeps the iterator alive. The garbage collector would later
        # delete the processes' queues first, and ending the processes would take five seconds.
        if loader.num_workers and batches is not None:
            batches._shutdown_workers()
