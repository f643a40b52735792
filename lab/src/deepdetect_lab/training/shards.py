"""Store images and labels in shards, for data sets larger than memory or on slow disks.

A shard is an uncompressed tar file in the layout of WebDataset. For every image it holds the file,
the file's name, and the labels of the image's views. The sampler reads a few shards at a time.
"""

from __future__ import annotations

import bisect
import contextlib
import functools
import hashlib
import io
import itertools
import json
import tarfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from deepdetect._shared.atomic import atomic_path
from deepdetect._shared.errors import BatchError, ImageError, OptionError
from deepdetect._shared.machine import map_in_processes
from deepdetect._shared.options import suggest_keywords
from deepdetect._shared.progress import progress
from deepdetect._shared.records import check_same, key, plain
from deepdetect.io.image import load_image
from deepdetect.io.masks import encode_mask, load_mask

from ..labels import LabelOptions
from .recipe import TrainingOptions
from .views import (
    SourceImage,
    View,
    label_key,
    label_view,
    list_images,
    render,
    train_val_split,
    views_of,
)

INDEX = "shards.json"

Files = tuple[tuple[Path, int], ...]


@dataclass(frozen=True)
class Shards:
    """A folder of shards, with the path (its name holds a digest) and number of images of each."""

    folder: Path
    training: Files
    validation: Files

    @staticmethod
    def open(folder: Path, options: TrainingOptions) -> Shards | None:
        """Read the index of a folder of shards; return None if there is no index.

        Raises:
            OptionError: the shards were made with options other than the given ones.
            ImageError: the index is damaged, or a shard is missing.
        """
        if not (folder / INDEX).is_file():
            if any(folder.glob("training-*-*.tar")):
                raise ImageError(f"the shards in {folder} are not complete: write them again")
            return None
        found = _read_index(folder, options)
        for path, _ in found.training + found.validation:
            if not path.is_file():
                raise ImageError(f"the shard {path} is missing: write the shards again")
        return found


class ShardSource:
    """Images and labels in shards. The recipe determines the views of the images."""

    def __init__(self, files: Files, options: TrainingOptions) -> None:
        self.files, self.options = files, options
        self.shard_sizes = tuple(count for _, count in files)
        self.ends = list(itertools.accumulate(self.shard_sizes))

    def __len__(self) -> int:
        return self.ends[-1] if self.ends else 0

    def __getitem__(self, index: int) -> SourceImage:
        """Return an image. Its path is relative to the folder from which the shards were made."""
        shard, key, sample = self._sample(index)
        name = _read(shard, sample["name.txt"]).decode()
        return SourceImage(Path(name), key.rpartition("_")[2], *views_of(name, self.options))

    def load(self, index: int, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return a view as (H, W, 3) uint8 RGB, and its label as (H, W) bool."""
        shard, _, sample = self._sample(index)
        try:
            (place,) = (place for name, place in sample.items() if name.startswith("image."))
            image = render(_read(shard, place), view)
            mask = load_mask(_read(shard, sample[f"label.{view.name}.png"]))
        except (ImageError, KeyError, ValueError) as error:
            raise _damaged(shard, f"{self[index].path}: {error}") from None
        if mask.shape != image.shape[:2]:
            raise _damaged(shard, f"the label of {self[index].path} has the wrong size")
        return image, mask

    def _sample(self, index: int) -> tuple[Path, str, Mapping[str, tuple[int, int]]]:
        """Return the shard of an image, the image's key, and its files as in `_read_members`."""
        number = bisect.bisect_right(self.ends, index)
        path, count = self.files[number]
        samples = _read_members(path)
        if len(samples) != count:
            raise _damaged(path, f"{len(samples)} images instead of {count}")
        key, sample = samples[index - self.ends[number] + count]
        return path, key, sample


@suggest_keywords
def write_shards(
    images: str | Path,
    output: str | Path,
    options: TrainingOptions,
    *,
    shard_size: int = 256,
    workers: int | None = None,
    quiet: bool = True,
) -> Shards:
    """Write images with their labels into shards, in parallel over processes.

    Existing shards with the same content are kept. So an interrupted call can be resumed, and when
    images have changed, only their shards are written again.

    Args:
        images: folder of images.
        output: folder for the shards, other than the folder of the images.
        options: the recipe, which determines the validation images, and all views and labels.
        shard_size: approximate number of images per shard.
        workers: number of processes, by default one per processor.
        quiet: do not show a progress bar.

    Raises:
        ImageError: the folder of images is missing, or has too few images.
        OptionError: `output` has shards that were made with other options.
        BatchError: some images cannot be read. Shards without these images are kept.
        DeepDetectError: a shard cannot be written.

    Example:
        >>> write_shards("images", "shards", TrainingOptions())  # doctest: +SKIP
    """
    if shard_size < 1:
        raise OptionError(f"`shard_size` must be at least 1, not {shard_size}")
    images, output = Path(images), Path(output)
    if images.resolve() == output.resolve():
        raise OptionError(f"{output} holds the images: choose another `output`")
    if (output / INDEX).exists():
        _read_index(output, options)
    listed = list_images(images, options, (output,), options.max_images)
    files: dict[str, list[tuple[Path, int]]] = {"training": [], "validation": []}
    tasks: list[ShardTask] = []
    for kind, part in zip(files, train_val_split(listed, options.val_fraction), strict=True):
        for number, chosen in enumerate(_deal(part, images, shard_size)):
            if not chosen:
                continue
            whole = kind == "training"
            rows = [
                (name, image, image.normal + image.dark if whole else image.validation_views)
                for name, image in chosen
            ]
            made_from = [
                (name, image.digest, *(view.name for view in views)) for name, image, views in rows
            ]
            digest = key(label_key(options.labels), made_from)[:12]
            path = output / f"{kind}-{number:06d}-{digest}.tar"
            files[kind].append((path, len(rows)))
            if not path.exists():
                tasks.append((path, rows))
    failures: list[str] = []
    total = sum(len(rows) for _, rows in tasks)
    work = functools.partial(_write_shard, labels=options.labels)
    with progress(total, "shards", "image", quiet) as bar:
        for count, unread in map_in_processes(work, tasks, workers):
            bar.update(count)
            failures += unread
    if failures:
        raise BatchError(
            f"{len(failures)} of {len(listed)} images cannot be read (other shards are kept)",
            sorted(failures),
        )
    index: dict[str, Any] = {"options": _fixed_options(options)}
    for kind, shards in files.items():
        index[kind] = [{"file": path.name, "images": count} for path, count in shards]
    with atomic_path(output / INDEX) as temporary:  # written last, when all shards are complete
        temporary.write_text(json.dumps(index, indent=1))
    return Shards(output, tuple(files["training"]), tuple(files["validation"]))


ShardTask = tuple[Path, Sequence[tuple[str, SourceImage, Sequence[View]]]]
"""A shard to write: its path, and for each of its images the name, `SourceImage` and views."""


def _deal(
    images: Sequence[SourceImage], root: Path, shard_size: int
) -> list[list[tuple[str, SourceImage]]]:
    """Assign images to shards by hashes of their names, so that a new image changes few shards."""
    shards: list[list[tuple[str, SourceImage]]] = [[] for _ in range(-(-len(images) // shard_size))]
    for image in images:
        name = image.path.relative_to(root).as_posix()
        checksum = hashlib.sha256(name.encode()).digest()
        shards[int.from_bytes(checksum[:8], "big") % len(shards)].append((name, image))
    return shards


def _write_shard(task: ShardTask, labels: LabelOptions) -> tuple[int, list[str]]:
    shard, rows = task
    failures: list[str] = []
    with contextlib.suppress(BatchError), atomic_path(shard) as temporary:
        with tarfile.open(temporary, "w") as tar:
            for k, (name, image, views) in enumerate(rows):
                try:
                    files = _files_of(name, image.path, views, labels)
                except ImageError as error:
                    failures.append(str(error))
                    continue
                for ending, content in files.items():
                    # The modification time is not stored, so the same images give the same file.
                    member = tarfile.TarInfo(f"{k:06d}_{image.digest}.{ending}")
                    member.size = len(content)
                    tar.addfile(member, io.BytesIO(content))
        if failures:
            raise BatchError("the shard is not complete", failures)
    return len(rows), failures


def _files_of(
    name: str, path: Path, views: Sequence[View], labels: LabelOptions
) -> dict[str, bytes]:
    rgb = load_image(path)
    files = {"name.txt": name.encode(), f"image{path.suffix.lower()}": path.read_bytes()}
    for view in views:
        mask = label_view(render(rgb, view), view, labels)
        files[f"label.{view.name}.png"] = encode_mask(mask)
    return files


@functools.lru_cache(maxsize=64)
def _read_members(path: Path) -> list[tuple[str, dict[str, tuple[int, int]]]]:
    """List a shard's images: the key of each, and the offset and size in bytes of its files."""
    samples: dict[str, dict[str, tuple[int, int]]] = {}
    try:
        with tarfile.open(path, "r:") as tar:
            for member in tar:
                key, _, ending = member.name.partition(".")
                samples.setdefault(key, {})[ending] = member.offset_data, member.size
    except (OSError, tarfile.TarError) as error:
        raise _damaged(path, error) from None
    return list(samples.items())


def _read(path: Path, place: tuple[int, int]) -> bytes:
    offset, size = place
    try:
        with path.open("rb") as file:
            file.seek(offset)
            return file.read(size)
    except OSError as error:
        raise _damaged(path, error) from None


def _read_index(folder: Path, options: TrainingOptions) -> Shards:
    try:
        index = dict(json.loads((folder / INDEX).read_bytes()))
        training, validation = (
            tuple((folder / Path(row["file"]).name, int(row["images"])) for row in index[kind])
            for kind in ("training", "validation")
        )
    except (OSError, KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise _damaged(folder / INDEX, error) from None
    advice = "use the same settings for the shards and the training, or write to another folder"
    check_same(folder / INDEX, index.get("options"), _fixed_options(options), advice)
    return Shards(folder, training, validation)


def _damaged(path: Path, reason: object) -> ImageError:
    return ImageError(f"{path} is damaged ({reason}): delete it and write the shards again")


def _fixed_options(options: TrainingOptions) -> dict[str, Any]:
    """Return, as JSON values, the options that must not change after the shards are written."""
    names = ("short_sides", "square", "max_images", "val_fraction", "augmentations")
    fixed = {name: plain(getattr(options, name)) for name in names}
    return {**fixed, "labels": label_key(options.labels)}
