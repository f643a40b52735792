"""The focal length that a camera has written into its photograph."""

from __future__ import annotations

import io
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import ReconstructionError
from ..geometry.camera import Calibration, Camera, Size

DIAGONAL_35MM = float(np.hypot(36, 24))
"""Diagonal of a 35 mm film's picture in mm, which the equivalent focal length refers to (CIPA)."""

MM_A_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
"""Of FocalPlaneResolutionUnit: inch, centimetre, and by custom millimetre and micrometre."""

ORIENTATION, EXIF_BLOCK = 0x0112, 0x8769
FOCAL_LENGTH, FOCAL_LENGTH_35MM = 0x920A, 0xA405
PLANE_X, PLANE_Y, PLANE_UNIT = 0xA20E, 0xA20F, 0xA210
WIDTH, HEIGHT = 0xA002, 0xA003

TURNED = (5, 6, 7, 8)
"""Orientations that change width and height."""

AGREEMENT = 0.1
"""Share by which the focal length by the resolution of the sensor may differ from that by the 35 mm
equivalent: the one is finer, but often wrong."""

ADVICE = "give `focal_px` or `calibration`"

SAME_SHAPE = 0.01
"""Share by which the ratio of the sides may differ from that of the photograph as it was taken."""


def calibration_from_exif(image0: Any, image1: Any, size0: Size, size1: Size) -> Calibration:
    """Return the calibration that two photographs carry; principal points in the middle.

    Args:
        image0, image1: paths, file contents as bytes, or PIL images, as of `load_image`.
        size0, size1: (width, height) in pixels as `load_image` gives them: files are turned
            upright, PIL images are not.

    Raises:
        ReconstructionError: a photograph carries no usable focal length.
    """
    left, right = camera_from_exif(image0, size0), camera_from_exif(image1, size1)
    return Calibration(left, right, source="EXIF")


def camera_from_exif(image: Any, size: Size) -> Camera:
    """Return the camera that a photograph carries.

    From FocalLength and the resolution of the sensor where these agree with
    FocalLengthIn35mmFilm or stand alone, else from FocalLengthIn35mmFilm by the diagonal.

    Args:
        image: a path, a file's content as bytes, or a PIL image.
        size: (width, height) in pixels, as `load_image` gives it.

    Raises:
        ReconstructionError: it carries no usable focal length, or has been cropped since.
    """
    name = f"{image}" if isinstance(image, (str, Path)) else "the image"
    tags, orientation = _tags(image)
    turned = orientation in TURNED and not hasattr(image, "getexif")
    own = (size[1], size[0]) if turned else size
    taken = (_number(tags.get(WIDTH)), _number(tags.get(HEIGHT)))
    if not min(taken) > 0:
        taken = (float(own[0]), float(own[1]))
    if abs(own[0] * taken[1] / (own[1] * taken[0]) - 1) > SAME_SHAPE:
        raise ReconstructionError(
            f"{name} was cropped after it was taken ({taken[0]:.0f}x{taken[1]:.0f} by its EXIF), "
            f"which its focal length does not tell: {ADVICE}"
        )
    film = _number(tags.get(FOCAL_LENGTH_35MM)) * float(np.hypot(*own)) / DIAGONAL_35MM
    focal = _by_sensor(tags, own[0] / taken[0])
    if focal is None or (film > 0 and abs(focal[0] / film - 1) > AGREEMENT):
        focal = (film, film)
    if not min(focal) > 0:
        raise ReconstructionError(f"{name} carries no focal length (EXIF): {ADVICE}")
    return Camera(size, focal[::-1] if turned else focal)


def _by_sensor(tags: dict[int, Any], scale: float) -> tuple[float, float] | None:
    """Return (fx, fy) in pixels from the resolution of the sensor, or None."""
    length = _number(tags.get(FOCAL_LENGTH))
    unit = MM_A_UNIT.get(int(_number(tags.get(PLANE_UNIT))) or 2, 0.0)
    across = _number(tags.get(PLANE_X))
    down = _number(tags.get(PLANE_Y)) or across
    if not (length > 0 and unit > 0 and across > 0 and down > 0):
        return None
    return length * across / unit * scale, length * down / unit * scale


def _tags(image: Any) -> tuple[dict[int, Any], int]:
    """Read the EXIF tags and the orientation; what cannot be read is not there."""
    from PIL import Image

    try:
        if hasattr(image, "getexif"):
            exif = image.getexif()
        elif isinstance(image, (str, Path, bytes)):
            file = io.BytesIO(image) if isinstance(image, bytes) else image
            with Image.open(file) as opened:
                exif = opened.getexif()
        else:
            return {}, 1
        return dict(exif.get_ifd(EXIF_BLOCK)), int(exif.get(ORIENTATION, 1))
    except Exception:  # Pillow's readers raise many kinds; a broken tag is no tag
        return {}, 1


def _number(value: Any) -> float:
    """Return a tag as a number; 0 for what is missing, broken or negative."""
    try:
        number = float(value) if not isinstance(value, tuple) else float(Fraction(*value))
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if np.isfinite(number) and number > 0 else 0.0
