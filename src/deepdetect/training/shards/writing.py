"""Writing photographs with their labels into shards."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...atomic import atomic_path
from ...errors import DeepDetectError, ImageError, OptionError
from ...image import load_image
from ...labels import LabelOptions
from ...labels.files import encode_mask
from ...processes import map_in_processes
from ...progress import progress
from ..label_cache import label_of_view
from ..photos import Photo, hold_out, list_photos, photos_digest
from ..recipe import TrainingOptions
from ..views import View
from .index import INDEX, Shards, claim_folder, fixed_options, write_json
from .library import webdataset


@dataclass(frozen=True)
class ShardTask:
    """A shard that is to be written.

    Attributes:
        path: its file.
        photos: what goes into it, each with the views whose labels are wanted.
        options: how labels are made.
    """

    path: Path
    photos: tuple[tuple[Photo, str, tuple[View, ...]], ...]
    options: LabelOptions


def write_shards(
    photos: Path,
    output: Path,
    options: TrainingOptions,
    *,
    photos_a_shard: int = 256,
    workers: int | None = None,
    quiet: bool = True,
) -> Shards:
    """Write photographs with their labels into shards, in parallel over processes.

    Shards that are there already, from a call that was broken off, stay.

    Args:
        photos: folder of photographs.
        output: folder for the shards.
        options: the recipe of the runs to come; some of its photographs are held out.
        photos_a_shard: photographs in a shard.
        workers: number of processes; default one for each processor.
        quiet: show no progress bar.

    Raises:
        ImageError: the folder is missing, or has too few photographs.
        OptionError: the folder has shards that were made otherwise.
        DeepDetectError: a photograph cannot be read; the other shards are kept.
    """
    if photos_a_shard < 1:
        raise OptionError(f"a shard needs at least one photograph, not {photos_a_shard}")
    webdataset()  # missing, it is missed before the work
    listed = list_photos(photos, options, (output,), options.max_photos)
    training, held = hold_out(listed, options.held_out)
    # Mixed once for all, so that no shard holds one kind of photograph only.
    order = np.random.default_rng(0).permutation(len(training))
    training = [training[k] for k in order]
    plan = {
        "options": fixed_options(options),
        "photographs": photos_digest(training, held),
        "photos_a_shard": photos_a_shard,
    }
    claim_folder(output, plan)
    files: dict[str, list[dict[str, Any]]] = {"training": [], "validation": []}
    tasks = []
    for kind, members in (("training", training), ("validation", held)):
        for k in range(0, len(members), photos_a_shard):
            part = members[k : k + photos_a_shard]
            path = output / f"{kind}-{k // photos_a_shard:06d}.tar"
            files[kind].append({"file": path.name, "photographs": len(part)})
            wanted = tuple(
                (photo, photo.path.relative_to(photos).as_posix(), _views(photo, kind))
                for photo in part
            )
            if not path.exists():
                tasks.append(ShardTask(path, wanted, options.label_options))
    with progress(sum(len(task.photos) for task in tasks), "shards", "photo", quiet) as bar:
        for done in map_in_processes(write_shard, tasks, workers):
            if isinstance(done, str):
                raise DeepDetectError(f"{done}; the shards that are whole are kept")
            bar.update(done)
    write_json(output / INDEX, {**plan, **files})
    return Shards.open(output, options)


def write_shard(task: ShardTask) -> int | str:
    """Write one shard; return how many photographs it has, or what went wrong."""
    try:
        with (
            atomic_path(task.path) as temporary,
            temporary.open("wb") as file,
            # No time of writing: the same photographs give the same file.
            webdataset().TarWriter(file, encoder=False, mtime=0) as writer,
        ):
            for k, (photo, name, views) in enumerate(task.photos):
                sample = _sample(photo, name, views, task.options)
                writer.write({"__key__": f"{k:06d}_{photo.digest}", **sample})
    except DeepDetectError as error:
        return str(error)
    return len(task.photos)


def _sample(
    photo: Photo, name: str, views: tuple[View, ...], options: LabelOptions
) -> dict[str, bytes]:
    """Return the files of a photograph by their endings."""
    try:
        content = photo.path.read_bytes()
        rgb = load_image(content)
    except OSError as error:
        raise ImageError(f"{photo.path} cannot be read ({error.strerror}): check it") from None
    except ImageError as error:
        raise ImageError(str(error).replace("the image", str(photo.path), 1)) from None
    sample = {"name.txt": name.encode(), f"photo{photo.path.suffix.lower()}": content}
    for view in views:
        sample[f"label.{view.name}.png"] = encode_mask(label_of_view(rgb, view, options))
    return sample


def _views(photo: Photo, kind: str) -> tuple[View, ...]:
    if kind == "validation":
        return photo.normal[0], photo.dark[0]
    return photo.normal + photo.dark
