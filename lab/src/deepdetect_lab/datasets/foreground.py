"""List photographs that have a mask of their foreground, for example ECSSD (Yan et al., 2013).

For each photograph NAME.jpg or NAME.png, the folder holds a mask NAME_mask.png. Masks are white on
the foreground.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from deepdetect._shared.errors import ImageError

SUFFIXES = (".jpg", ".png")


@dataclass(frozen=True)
class MaskedPhotograph:
    """The files of a photograph and of its foreground mask."""

    image: Path
    mask: Path


def load_foreground(folder: str | Path) -> list[MaskedPhotograph]:
    """List the photographs with masks in a folder; raise an ImageError if there are none."""
    found = []
    for mask in sorted(Path(folder).glob("*_mask.png")):
        stem = mask.name.removesuffix("_mask.png")
        images = [p for e in SUFFIXES if (p := mask.with_name(stem + e)).exists()]
        if images:
            found.append(MaskedPhotograph(images[0], mask))
    if not found:
        raise ImageError(
            f"there are no photographs with masks in {folder}: put NAME.jpg and NAME_mask.png there"
        )
    return found
