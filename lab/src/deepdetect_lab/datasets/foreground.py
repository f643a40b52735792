"""Photographs with a mask of their foreground, for example ECSSD (Yan et al., 2013).

NAME.jpg (or .png) and NAME_mask.png lie side by side; the mask is white on the foreground.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from deepdetect._shared.errors import ImageError

SUFFIXES = (".jpg", ".png")


@dataclass(frozen=True)
class MaskedPhotograph:
    """A photograph's file and that of its foreground."""

    image: Path
    mask: Path


def load_foreground(folder: str | Path) -> list[MaskedPhotograph]:
    """List the photographs that have a mask; an ImageError where there is none."""
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
