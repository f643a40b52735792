"""What a run needs before its first step: photographs, their views, all labels."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from .cluster import distributed_context, wait_for_all
from .feed import Example, Feed, FileFeed, StoredExample
from .label_cache import LabelCache
from .photos import Photo, list_photos, photos_digest, train_val_split
from .recipe import TrainingOptions
from .shards import HeldExamples, ShardFeed, Shards, has_shards
from .view_store import ViewStore


@dataclass(frozen=True)
class Photographs:
    """The photographs of a run.

    Attributes:
        training: those to train on.
        held: those to validate with.
        digest: a digest of which photographs there are.
    """

    training: Feed
    held: Iterable[Example]
    digest: str


@dataclass(frozen=True)
class Sources:
    """The folders of a run.

    Attributes:
        photos: folder of photographs, or of shards (`deepdetect shards`).
        output: folder of the run, which is left out when it lies below the photographs.
        validation: folder of other photographs; None holds some of the first out.
        labels: folder for the label cache; None means one in `output`.
    """

    photos: Path
    output: Path
    validation: str | Path | None = None
    labels: str | Path | None = None

    @property
    def label_cache(self) -> Path:
        """The folder for the label cache."""
        return self.output / "labels" if self.labels is None else Path(self.labels)


def prepare(
    sources: Sources, options: TrainingOptions, workers: int | None = None, quiet: bool = True
) -> Photographs:
    """List the photographs of a run and make the labels of all their views.

    The first process of each machine makes the labels, the others wait for it.

    Args:
        sources: the folders.
        options: the recipe.
        workers: processes that make labels; default one for each processor.
        quiet: show no progress bar.

    Raises:
        ImageError: a folder is missing or empty.
        OptionError: a batch cannot be shared evenly by the processes.
        DeepDetectError: a photograph cannot be read.
    """
    for stage in options.stages:
        distributed_context().local_slice(stage.batch)  # an uneven share is told before the labels
    if has_shards(sources.photos):
        return _sharded(sources, options, workers, quiet)
    exclude = (sources.output, sources.label_cache)
    training = list_photos(sources.photos, options, exclude, options.max_photos)
    if sources.validation is None:
        training, held = train_val_split(training, options.val_fraction)
    else:
        held = list_photos(Path(sources.validation), options, exclude)
    store = _stored(sources, options, training, held, workers, quiet)
    return Photographs(
        FileFeed(training, store, options.seed),
        [StoredExample(photo, store) for photo in held],
        photos_digest(training, held),
    )


def _sharded(
    sources: Sources, options: TrainingOptions, workers: int | None, quiet: bool
) -> Photographs:
    """Take the photographs from shards; those to validate with, too, unless a folder is named."""
    shards = Shards.open(sources.photos, options)
    training = ShardFeed(shards, options)
    if sources.validation is None:
        return Photographs(training, HeldExamples(shards, options), shards.digest)
    held = list_photos(Path(sources.validation), options, (sources.output, sources.label_cache))
    store = _stored(sources, options, [], held, workers, quiet)
    digest = f"{shards.digest} {photos_digest([], held)}"
    return Photographs(training, [StoredExample(photo, store) for photo in held], digest)


def _stored(
    sources: Sources,
    options: TrainingOptions,
    training: list[Photo],
    held: list[Photo],
    workers: int | None,
    quiet: bool,
) -> ViewStore:
    """Make the labels of photographs in files."""
    store = ViewStore(LabelCache(sources.label_cache, options.label_options))
    dark_ones = options.dark_fraction > 0
    wanted = [(photo, photo.normal + photo.dark * dark_ones) for photo in training]
    wanted += [(photo, (photo.normal[0], photo.dark[0])) for photo in held]
    place = distributed_context()
    if place.local_rank == 0:
        store.labels.make(wanted, workers, quiet or not place.is_first)
    wait_for_all(place)
    return store
