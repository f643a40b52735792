"""Files in folders of images that are no further images: masks, and unknown suffixes."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from .image_file import FORMATS, identify

MASK_WORD = re.compile(r"^masks?([ ._-]+|$)|[ ._-]+masks?(?=[ ._-]|$)", re.IGNORECASE)
"""This word is what distinguishes the name of a mask, or of a folder of masks."""


def holds_image(path: Path) -> bool:
    """Return whether a file of any suffix begins like an image that can be opened."""
    with suppress(Exception), path.open("rb") as file:  # Pillow's readers raise many kinds
        return identify(file, "", [key for key in FORMATS if key != "TGA"]) is not None
    return False


def masks_among(paths: Sequence[Path]) -> dict[Path, None]:
    """Return those of the image files that are named as masks of others.

    Masks of NAME.jpg are NAME_mask.png, NAME.mask.png, mask_NAME.png and NAME.jpg.png in its
    folder, and these and NAME.png in a folder `masks` in this folder or next to it. Separators,
    case and suffixes do not matter.
    """
    whole = {(path.parent, path.name.casefold()) for path in paths if path.suffix}
    stems = {(path.parent, path.stem.casefold()) for path in paths}
    folders = defaultdict[Path, set[Path]](set)  # also by their paths without one of the parts
    for folder in {path.parent for path in paths}:
        folders[folder].add(folder)
        for marked, shorter in _shortened(folder):
            folders[shorter] |= set() if marked else {folder}

    def is_mask(path: Path) -> bool:
        plain = MASK_WORD.sub("", path.stem)
        places = [short for marked, short in _shortened(path.parent) if marked]
        near = {(f, plain.casefold()) for short in places for f in folders.get(short, ())}
        own = {(path.parent, plain.casefold())}
        return bool((own | near) & whole or (near if plain == path.stem else own | near) & stems)

    return dict.fromkeys(filter(is_mask, paths))


def _shortened(folder: Path) -> Iterator[tuple[bool, Path]]:
    """Yield a path without each of its parts, and whether this part names a folder of masks."""
    parts = folder.parts
    for k, part in enumerate(parts):
        yield MASK_WORD.search(part) is not None, Path(*parts[:k], *parts[k + 1 :])
