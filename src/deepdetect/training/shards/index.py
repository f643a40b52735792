"""What is in a folder of shards."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...atomic import atomic_path
from ...errors import ImageError, OptionError
from ..label_cache import settings_digest
from ..recipe import TrainingOptions

INDEX = "shards.json"
PLAN = "plan.json"


@dataclass(frozen=True)
class Shards:
    """A folder of shards.

    Attributes:
        folder: the folder.
        training, validation: files, each with the number of its photographs.
        digest: a digest of which photographs there are.
    """

    folder: Path
    training: tuple[tuple[Path, int], ...]
    validation: tuple[tuple[Path, int], ...]
    digest: str

    @classmethod
    def open(cls, folder: Path, options: TrainingOptions) -> Shards:
        """Read the index of a folder of shards.

        Raises:
            OptionError: the labels in it are not those of the options.
            ImageError: the index is damaged, or a shard is missing.
        """
        try:
            index = json.loads((folder / INDEX).read_text())
            kinds = [
                tuple((folder / row["file"], int(row["photographs"])) for row in index[kind])
                for kind in ("training", "validation")
            ]
            made, digest = index["options"], index["photographs"]
        except (OSError, ValueError, KeyError, TypeError):
            raise ImageError(
                f"{folder / INDEX} cannot be read: make the shards anew with deepdetect shards"
            ) from None
        _compare(folder, made, options)
        for path, _ in kinds[0] + kinds[1]:
            if not path.is_file():
                raise ImageError(f"the shard {path} is missing: run deepdetect shards again")
        return cls(folder, kinds[0], kinds[1], digest)


def has_shards(folder: Path) -> bool:
    """Return whether a folder holds shards."""
    return (folder / INDEX).is_file()


def fixed_options(options: TrainingOptions) -> dict[str, Any]:
    """Return what of a recipe is fixed once the labels are made, as JSON would give it back."""
    fixed = {
        "short_sides": options.short_sides,
        "square": options.square,
        "max_photos": options.max_photos,
        "held_out": options.held_out,
        "dark_variants": options.dark_variants,
        "darkening": dataclasses.asdict(options.darkening),
        "labels": settings_digest(options.label_options),
    }
    return json.loads(json.dumps(fixed))


def claim_folder(folder: Path, plan: dict[str, Any]) -> None:
    """Make sure that shards which are there already belong to the same plan.

    Raises:
        OptionError: they do not.
    """
    path = folder / PLAN
    if not path.exists():
        write_json(path, plan)
        return
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        found = None
    if found != plan:
        raise OptionError(
            f"{folder} holds shards of other photographs or options: choose another folder with -o"
        )


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write a JSON file, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(values, indent=1))


def _compare(folder: Path, made: dict[str, Any], options: TrainingOptions) -> None:
    fixed = fixed_options(options)
    other = [name for name in fixed if made.get(name) != fixed[name]]
    if other:
        raise OptionError(
            f"the shards in {folder} were made with other options ({', '.join(other)}): "
            "give deepdetect shards and deepdetect train the same, or make them anew"
        )
