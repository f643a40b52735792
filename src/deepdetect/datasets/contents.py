"""Digests of what is in the files of a data set, whatever format they are stored in."""

from __future__ import annotations

import hashlib
import json
from importlib import resources
from pathlib import Path

import cv2
import numpy as np

from ..io.image import IMAGE_SUFFIXES


def content_digest(folder: Path, name: str) -> str | None:
    """Return the SHA-256 of a file's content.

    Of an image it is that of its pixels and their shape and type, so that a lossless copy in
    another format has the same; its name is given without the ending. Of any other file it is
    that of its numbers or words, without white space.

    Args:
        folder: the data set.
        name: path in it.

    Returns:
        64 hexadecimal digits, or None when there is no such file.
    """
    path = folder / name
    if path.is_file() and path.suffix.lower() not in IMAGE_SUFFIXES:
        words = path.read_text(encoding="utf-8", errors="replace").split()
        return hashlib.sha256(" ".join(words).encode()).hexdigest()
    for candidate in sorted(path.parent.glob(f"{path.name}.*")):
        if candidate.suffix.lower() in IMAGE_SUFFIXES:
            pixels = cv2.imread(str(candidate), cv2.IMREAD_UNCHANGED)
            return None if pixels is None else _pixel_digest(pixels)
    return None


def known_contents(name: str) -> dict[str, str]:
    """Read the digests of a data set that the package knows."""
    text = resources.files("deepdetect").joinpath(f"datasets/known/{name}.json").read_text("utf-8")
    return json.loads(text)


def _pixel_digest(pixels: np.ndarray) -> str:
    head = f"{pixels.shape} {pixels.dtype}".encode()
    return hashlib.sha256(head + np.ascontiguousarray(pixels).tobytes()).hexdigest()
