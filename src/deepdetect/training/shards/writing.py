"""Writing photographs with their labels into shards."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..._shared.atomic import atomic_path
from ..._shared.errors import DeepDetectError, ImageError, OptionError
from ..._shared.parallel import map_in_processes
from ..._shared.progress import progress
from ...io.image import load_image
from ...io.masks import encode_mask
from ...labels import LabelOptions
from ..label_cache import label_of_view, settings_digest
from ..photos import Photo, list_photos, train_val_split
from ..recipe import TrainingOptions
from ..views import View
from .index import Shards, check_index, write_index
from .library import webdataset


@dataclass(frozen=True)
class Member:
    """A photograph that goes into a shard.

    Attributes:
        photo: the photograph.
        name: its path in the folder, from which its dark views are drawn.
        views: those whose labels are wanted.
    """

    photo: Photo
    name: str
    views: tuple[View, ...]


@dataclass(frozen=True)
class ShardTask:
    """A shard that is to be written.

    Attributes:
        path: its file.
        members: what goes into it.
        options: how labels are made.
    """

    path: Path
    members: tuple[Member, ...]
    options: LabelOptions


def write_shards(
    photos: Path,
    output: Path,
    options: TrainingOptions,
    *,
    shard_size: int = 256,
    workers: int | None = None,
    quiet: bool = True,
) -> Shards:
    """Write photographs with their labels into shards, in parallel over processes.

    Shards that are there already and hold the same, stay: a call that was broken off goes on,
    and when some photographs have changed, their shards are written anew.

    Args:
        photos: folder of photographs.
        output: another folder, for the shards.
        options: the recipe of the runs to come; some of its photographs are held out.
        shard_size: about so many photographs go into a shard.
        workers: number of processes; default one for each processor.
        quiet: show no progress bar.

    Raises:
        ImageError: the folder is missing, or has too few photographs.
        OptionError: the folder has shards that were made with other options.
        DeepDetectError: photographs cannot be read; the other shards are kept.

    Example:
        >>> write_shards(Path("photos"), Path("shards"), TrainingOptions())  # doctest: +SKIP
    """
    if shard_size < 1:
        raise OptionError(f"a shard needs at least one photograph, not {shard_size}")
    if photos.resolve() == output.resolve():
        raise OptionError(f"{output} holds the photographs: choose another folder with -o")
    webdataset()  # missing, it is missed before the work
    check_index(output, options)
    listed = list_photos(photos, options, (output,), options.max_photos)
    files: dict[str, list[tuple[Path, int]]] = {}
    tasks = []
    training, held = train_val_split(listed, options.val_fraction)
    for kind, part in (("training", training), ("validation", held)):
        members = [_member(photo, photos, kind) for photo in part]
        files[kind] = []
        for number, shard in enumerate(_dealt(members, shard_size)):
            if not shard:
                continue
            path = output / f"{kind}-{number:06d}-{_digest(shard, options)}.tar"
            files[kind].append((path, len(shard)))
            if not path.exists():
                tasks.append(ShardTask(path, tuple(shard), options.label_options))
    failures = []
    with progress(sum(len(task.members) for task in tasks), "shards", "photo", quiet) as bar:
        for done in map_in_processes(write_shard, tasks, workers):
            if isinstance(done, str):
                failures.append(done)
            else:
                bar.update(done)
    if failures:
        raise DeepDetectError(
            f"{len(failures)} of {len(tasks)} shards cannot be written, the others are kept; "
            f"the first: {failures[0]}"
        )
    made = Shards(output, tuple(files["training"]), tuple(files["validation"]))
    write_index(made, options)
    return made


def write_shard(task: ShardTask) -> int | str:
    """Write one shard; return how many photographs it has, or what went wrong."""
    try:
        with (
            atomic_path(task.path) as temporary,
            temporary.open("wb") as file,
            # No time of writing: the same photographs give the same file.
            webdataset().TarWriter(file, encoder=False, mtime=0) as writer,
        ):
            for k, member in enumerate(task.members):
                key = f"{k:06d}_{member.photo.digest}"
                writer.write({"__key__": key, **_sample(member, task.options)})
    except DeepDetectError as error:
        return str(error)
    return len(task.members)


def _member(photo: Photo, root: Path, kind: str) -> Member:
    views = photo.normal + photo.dark
    if kind == "validation":
        views = (photo.normal[0], photo.dark[0])
    return Member(photo, photo.path.relative_to(root).as_posix(), views)


def _dealt(members: Sequence[Member], shard_size: int) -> list[list[Member]]:
    """Deal photographs to shards by the checksums of their names.

    So no shard holds one kind of photograph only, and most shards stay as they are when a
    photograph goes or comes.
    """
    shards: list[list[Member]] = [[] for _ in range(-(-len(members) // shard_size))]
    for member in members:
        checksum = hashlib.sha256(member.name.encode()).digest()
        shards[int.from_bytes(checksum[:8], "big") % len(shards)].append(member)
    return shards


def _digest(members: Sequence[Member], options: TrainingOptions) -> str:
    """Return a digest of all that a shard's content depends on."""
    parts = [settings_digest(options.label_options)]
    for member in members:
        parts += [member.name, member.photo.digest, *(view.name for view in member.views)]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]


def _sample(member: Member, options: LabelOptions) -> dict[str, bytes]:
    """Return the files of a photograph by their endings."""
    path = member.photo.path
    try:
        content = path.read_bytes()
        rgb = load_image(content)
    except OSError as error:
        raise ImageError(f"{path} cannot be read ({error.strerror}): check its rights") from None
    except ImageError as error:
        raise ImageError(str(error).replace("the image", str(path), 1)) from None
    sample = {"name.txt": member.name.encode(), f"photo{path.suffix.lower()}": content}
    for view in member.views:
        sample[f"label.{view.name}.png"] = encode_mask(label_of_view(rgb, view, options))
    return sample
