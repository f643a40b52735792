"""Files in folders of images that are no further images: masks, and unknown suffixes."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Sequence
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


def without_masks(paths: Iterable[Path]) -> list[Path]:
    """Return the image files without those that are named as masks of others; warn about these.

    Masks of NAME.jpg are NAME_mask.png, NAME.mask.png, mask_NAME.png and NAME.jpg.png in its
    folder, and these and NAME.png below a folder `masks` in this folder or a folder above it.
    """
    paths = [*paths]
    places = {place for path in paths for place in _around_masks(path)}
    stems, names = set[tuple[Path, str]](), set[tuple[Path, str]]()
    for path in paths:
        stems.add((path.parent, path.stem.casefold()))
        names |= {(path.parent, path.name.casefold())} if path.suffix else set()
        for place in places.intersection(path.parents):
            if not any(map(MASK_WORD.search, path.relative_to(place).parts[:-1])):
                names |= {(place / "masks", each.casefold()) for each in (path.stem, path.name)}

    def is_mask(path: Path) -> bool:
        name = MASK_WORD.sub("", path.stem).casefold()
        own = (path.parent, name)
        near = {(place / "masks", name) for place in _around_masks(path)}
        return own in names or (name != path.stem.casefold() and own in stems) or bool(near & names)

    masks = [path for path in paths if is_mask(path)]
    tell_left_out(masks, "files named as masks of other images")
    return [path for path in paths if path not in {*masks}]


def _around_masks(path: Path) -> list[Path]:
    """Return the folders with a folder of masks in which the path is."""
    return [folder.parent for folder in path.parents if MASK_WORD.search(folder.name)]


def tell_left_out(paths: Sequence[Path], what: str) -> None:
    """Warn that files are left out."""
    if paths:
        text = f"{len(paths)} {what} are left out, such as {paths[0]} (rename them to use them)"
        warnings.warn(text, UserWarning, stacklevel=4)
