"""Reading photographs with their labels from shards, in a random order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..._shared.errors import ImageError
from ...io.masks import load_mask
from ..photos import Photo
from ..prefetch import prefetched
from ..recipe import TrainingOptions
from ..views import View, render, views_of
from .index import Shards
from .library import webdataset

SHUFFLE_BUFFER_SHARDS = 4
"""So many shards are in memory at a time, mixed; and as many more on their way."""


@dataclass(frozen=True)
class ShardExample:
    """A photograph of a shard.

    Attributes:
        shard: the shard's file.
        photo: its views; the path is its name in the folder it came from.
        content: the photograph's file.
        labels: the files of the labels, by the name of the view.
    """

    shard: Path
    photo: Photo
    content: bytes
    labels: dict[str, bytes]

    def load(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return a view as (H, W, 3) uint8 RGB, and its label as (H, W) bool.

        Raises:
            ImageError: the photograph or its label is damaged.
        """
        try:
            image, mask = render(self.content, view), load_mask(self.labels[view.name])
        except (ImageError, KeyError) as error:
            raise _damaged(self.shard, f"{self.photo.path}: {error}") from None
        if mask.shape != image.shape[:2]:
            raise _damaged(self.shard, f"the label of {self.photo.path} has another size")
        return image, mask


class ShardFeed:
    """Photographs in shards.

    Args:
        shards: the shards.
        options: the recipe, whose seed decides the order.
    """

    def __init__(self, shards: Shards, options: TrainingOptions) -> None:
        self.shards, self.options = shards, options

    def __len__(self) -> int:
        return sum(count for _, count in self.shards.training)

    def epoch(self, number: int, first: int = 0) -> Iterator[ShardExample]:
        """Yield the photographs of an epoch from its place `first` on.

        Shards that lie wholly before that place are not read.
        """
        files = self.shards.training
        order = np.random.default_rng([self.options.seed, 3, number]).permutation(len(files))
        groups = [
            order[k : k + SHUFFLE_BUFFER_SHARDS]
            for k in range(0, len(order), SHUFFLE_BUFFER_SHARDS)
        ]
        tasks = []
        for k, group in enumerate(groups):
            count = sum(files[shard][1] for shard in group)
            if first < count:
                tasks.append((number, k, [files[shard] for shard in group], first))
            first = max(first - count, 0)
        for examples in prefetched(lambda task: self._mixed(*task), tasks, threads=1, ahead=1):
            yield from examples

    def _mixed(
        self, number: int, k: int, files: Sequence[tuple[Path, int]], first: int
    ) -> list[ShardExample]:
        """Read some shards and mix their photographs; leave out the first so many."""
        examples = [example for file in files for example in read_shard(*file, self.options)]
        generator = np.random.default_rng([self.options.seed, 4, number, k])
        return [examples[place] for place in generator.permutation(len(examples))[first:]]


class HeldExamples:
    """The photographs to validate with, read anew each time, one after the other.

    Args:
        shards: the shards.
        options: the recipe.
    """

    def __init__(self, shards: Shards, options: TrainingOptions) -> None:
        self.shards, self.options = shards, options

    def __iter__(self) -> Iterator[ShardExample]:
        for path, count in self.shards.validation:
            yield from read_shard(path, count, self.options)


def read_shard(path: Path, count: int, options: TrainingOptions) -> Iterator[ShardExample]:
    """Read the photographs of a shard in turn.

    Args:
        path: its file.
        count: how many there are.
        options: the recipe, by which the views are drawn.

    Raises:
        ImageError: it is damaged.
    """
    iterators = webdataset().tariterators
    found = 0
    try:
        with path.open("rb") as file:
            files = iterators.tar_file_expander([{"url": str(path), "stream": file}])
            for sample in iterators.group_by_keys(files):
                yield _example(path, sample, options)
                found += 1
    except Exception as error:  # tar, WebDataset and the system raise many kinds
        raise _damaged(path, str(error)) from None
    if found != count:
        raise _damaged(path, f"{found} photographs instead of {count}")


def _damaged(shard: Path, reason: str) -> ImageError:
    return ImageError(
        f"the shard {shard} is damaged ({reason}): delete it and run deepdetect shards again"
    )


def _example(shard: Path, sample: dict[str, Any], options: TrainingOptions) -> ShardExample:
    """Return the photograph of one sample, a dictionary of files by their endings."""
    name = sample["name.txt"].decode()
    (content,) = (value for ending, value in sample.items() if ending.startswith("photo."))
    labels = {
        ending.removeprefix("label.").removesuffix(".png"): value
        for ending, value in sample.items()
        if ending.startswith("label.")
    }
    views = views_of(
        name,
        options.short_sides,
        options.darkening,
        options.dark_variants,
        options.square,
        options.augmentations,
    )
    photo = Photo(Path(name), sample["__key__"].rpartition("_")[2], *views)
    return ShardExample(shard, photo, content, labels)
