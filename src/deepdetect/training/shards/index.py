"""What is in a folder of shards."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..._shared.atomic import atomic_path
from ..._shared.errors import ImageError, OptionError
from ..label_cache import settings_digest
from ..recipe import TrainingOptions

INDEX = "shards.json"


@dataclass(frozen=True)
class Shards:
    """A folder of shards.

    Attributes:
        folder: the folder.
        training, validation: files, each with the number of its photographs. Their names
            hold a digest of what is in them.
    """

    folder: Path
    training: tuple[tuple[Path, int], ...]
    validation: tuple[tuple[Path, int], ...]

    @classmethod
    def open(cls, folder: Path, options: TrainingOptions) -> Shards:
        """Read the index of a folder of shards.

        Args:
            folder: the folder.
            options: the recipe that they are for.

        Raises:
            OptionError: the labels in it are not those of the options.
            ImageError: the index is damaged, or a shard is missing.
        """
        try:
            index = json.loads((folder / INDEX).read_text())
            training, validation = (
                tuple((folder / row["file"], int(row["photographs"])) for row in index[kind])
                for kind in ("training", "validation")
            )
            made = dict(index["options"])
        except (OSError, ValueError, KeyError, TypeError):
            raise ImageError(
                f"{folder / INDEX} cannot be read: run deepdetect shards again"
            ) from None
        _compare(folder, made, options)
        for path, _ in training + validation:
            if not path.is_file():
                raise ImageError(f"the shard {path} is missing: run deepdetect shards again")
        return cls(folder, training, validation)

    @property
    def digest(self) -> str:
        """A digest of which photographs there are, and how they are packed."""
        rows = [[path.name, count] for path, count in self.training + self.validation]
        return hashlib.sha256(json.dumps(rows).encode()).hexdigest()[:16]


def has_shards(folder: Path) -> bool:
    """Return whether a folder holds shards.

    Raises:
        ImageError: it holds some, but not all of them are written.
    """
    if (folder / INDEX).is_file():
        return True
    if any(folder.glob("training-*-*.tar")):
        raise ImageError(f"the shards in {folder} are not finished: run deepdetect shards again")
    return False


def write_index(shards: Shards, options: TrainingOptions) -> None:
    """Write the index, after all shards."""
    index: dict[str, Any] = {"options": _fixed_options(options)}
    for kind, files in (("training", shards.training), ("validation", shards.validation)):
        index[kind] = [{"file": path.name, "photographs": count} for path, count in files]
    with atomic_path(shards.folder / INDEX) as temporary:
        temporary.write_text(json.dumps(index, indent=1))


def check_index(folder: Path, options: TrainingOptions) -> None:
    """Make sure that shards which are there already are for the same options.

    Raises:
        OptionError: they are not.
    """
    try:
        made = dict(json.loads((folder / INDEX).read_text())["options"])
    except (OSError, ValueError, KeyError, TypeError):
        return  # none, or not finished: what fits is told by the names
    _compare(folder, made, options)


def _fixed_options(options: TrainingOptions) -> dict[str, Any]:
    """Return what of a recipe is fixed once the labels are made, as JSON would give it back."""
    fixed = {
        "short_sides": options.short_sides,
        "square": options.square,
        "max_photos": options.max_photos,
        "val_fraction": options.val_fraction,
        "dark_variants": options.dark_variants,
        "augmentations": options.augmentations,
        "darkening": dataclasses.asdict(options.darkening),
        "labels": settings_digest(options.label_options),
    }
    return json.loads(json.dumps(fixed))


def _compare(folder: Path, made: dict[str, Any], options: TrainingOptions) -> None:
    fixed = _fixed_options(options)
    made = {"augmentations": 0, **made}  # shards of an older version have none
    other = [name for name in fixed if made.get(name) != fixed[name]]
    if other:
        raise OptionError(
            f"the shards in {folder} were made with other options ({', '.join(other)}): give "
            "deepdetect shards and deepdetect train the same, or write to another folder"
        )
