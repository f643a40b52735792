"""Files in image folders that are left out: masks, and images with unknown suffixes."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from .image_file import FORMATS, identify, open_image

MASK_WORD = re.compile(r"^masks?([ ._-]+|$)|[ ._-]+masks?(?=[ ._-]|$)", re.IGNORECASE)
"""This pattern finds the word "mask" in the name of a mask, or of a folder of masks."""


def holds_image(path: Path) -> bool:
    """Return whether a file of any suffix begins like an image that can be opened."""
    with suppress(Exception), path.open("rb") as file:  # Pillow's readers raise many errors
        return identify(file, "", [key for key in FORMATS if key != "TGA"]) is not None
    return False


def without_masks(paths: Iterable[Path]) -> list[Path]:
    """Return the image files except masks of other images; warn about the masks.

    Masks of NAME.jpg are NAME_mask.png, NAME.mask.png, mask_NAME.png and NAME.jpg.png in its
    folder or below a folder `masks`, and NAME.png below a folder `masks`. If there is no NAME.jpg,
    an image with such a name is a mask if it has at most two grey levels.
    """
    paths = [*paths]
    folders = {path.parent for path in paths}
    shared = set.intersection(*({*folder.parts} for folder in folders or {Path()}))
    marked = {each for each in folders if any(map(MASK_WORD.search, {*each.parts} - shared))}
    stems = {(path.parent, path.stem.casefold()) for path in paths}
    names = {(path.parent, path.name.casefold()) for path in paths if path.suffix}
    photographs = {name for folder, name in stems | names if folder not in marked}

    def is_mask(path: Path) -> bool:
        name = MASK_WORD.sub("", path.stem).casefold()
        own, called = (path.parent, name), name != path.stem.casefold()
        if own in names or (called and own in stems):
            return True
        inside = path.parent in marked
        return (inside and name in photographs) or ((inside or called) and _has_two_levels(path))

    masks = dict.fromkeys(filter(is_mask, paths))
    if len(masks) == len(paths):
        return paths
    tell_left_out([*masks], "masks of other images")
    return [path for path in paths if path not in masks]


def _has_two_levels(path: Path) -> bool:
    with suppress(Exception), open_image(path) as image:
        return image.convert("L").getcolors(2) is not None
    return False


def tell_left_out(paths: Sequence[Path], what: str) -> None:
    """Warn that the files `paths` are left out; `what` says what they are, in the plural."""
    if paths:
        first = Path(*paths[0].parts[-2:])  # the same for relative and absolute paths
        text = f"{len(paths)} {what} are left out, such as {first} (rename them to use them)"
        warnings.warn(text, UserWarning, stacklevel=4)
