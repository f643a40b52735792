"""Reading photographs with their labels from shards, in a random order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import ImageError
from ...labels.files import load_mask
from ..photos import Photo
from ..prefetch import prefetched
from ..recipe import TrainingOptions
from ..views import View, render, views_of
from .index import Shards
from .library import webdataset

MIXED = 4
"""So many shards are in memory at a time, mixed; and as many more on their way."""


@dataclass(frozen=True)
class ShardExample:
    """A photograph of a shard.

    Attributes:
        photo: its views; the path is its name in the folder it came from.
        content: the photograph's file.
        labels: the files of the labels, by the name of the view.
    """

    photo: Photo
    content: bytes
    labels: dict[str, bytes]

    def load(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return a view as (H, W, 3) uint8 RGB, and its label as (H, W) bool."""
        return render(self.content, view), load_mask(self.labels[view.name])


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
        groups = [order[k : k + MIXED] for k in range(0, len(order), MIXED)]
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
        examples: list[ShardExample] = []
        for path, count in files:
            found = list(read_shard(path, self.options))
            if len(found) != count:
                raise ImageError(
                    f"{path} has {len(found)} photographs instead of {count}: "
                    "delete it and run deepdetect shards again"
                )
            examples += found
        generator = np.random.default_rng([self.options.seed, 4, number, k])
        return [examples[place] for place in generator.permutation(len(examples))[first:]]


def held_examples(shards: Shards, options: TrainingOptions) -> list[ShardExample]:
    """Read the photographs to validate with."""
    return [example for path, _ in shards.validation for example in read_shard(path, options)]


def read_shard(path: Path, options: TrainingOptions) -> Iterator[ShardExample]:
    """Read the photographs of a shard in turn.

    Raises:
        ImageError: it is damaged.
    """
    iterators = webdataset().tariterators
    try:
        with path.open("rb") as file:
            files = iterators.tar_file_expander([{"url": str(path), "stream": file}])
            for sample in iterators.group_by_keys(files):
                yield _example(sample, options)
    except Exception as error:  # tar, WebDataset and the system raise many kinds
        raise ImageError(
            f"the shard {path} is damaged ({error}): delete it and run deepdetect shards again"
        ) from None


def _example(sample: dict[str, Any], options: TrainingOptions) -> ShardExample:
    """Return the photograph of one sample, a dictionary of files by their endings."""
    name = sample["name.txt"].decode()
    (content,) = (value for ending, value in sample.items() if ending.startswith("photo."))
    labels = {
        ending.removeprefix("label.").removesuffix(".png"): value
        for ending, value in sample.items()
        if ending.startswith("label.")
    }
    views = views_of(
        name, options.short_sides, options.darkening, options.dark_variants, options.square
    )
    photo = Photo(Path(name), sample["__key__"].rpartition("_")[2], *views)
    return ShardExample(photo, content, labels)
