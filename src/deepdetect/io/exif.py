"""Focal lengths from the EXIF tags of photographs."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import numpy as np
from PIL.ExifTags import IFD, Base

from .._shared.errors import ReconstructionError
from ..geometry.camera import Calibration, Camera, Size
from .image_file import file_name, is_file, open_image

DIAGONAL_35MM_MM = float(np.hypot(36, 24))
"""Diagonal of a 35 mm film frame, which defines the 35 mm equivalent focal length (CIPA)."""

MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
"""Length in mm of the unit for each code of FocalPlaneResolutionUnit: inch and cm as in the
standard, and mm and micrometre, which cameras also use."""

TRANSPOSED = (5, 6, 7, 8)
"""EXIF orientations that exchange width and height."""

MAX_FOCAL_DIFFERENCE, MAX_ASPECT_DIFFERENCE = 0.1, 0.01
"""The focal length by sensor resolution is more precise than the 35 mm equivalent, but often wrong:
it is used if the two differ by at most the fraction MAX_FOCAL_DIFFERENCE. A photograph was cropped
if its aspect ratio and that in its EXIF differ by over MAX_ASPECT_DIFFERENCE. Chosen by hand."""

ADVICE = "give `focal_px` or `calibration`"


def calibration_from_exif(image0: Any, image1: Any, size0: Size, size1: Size) -> Calibration:
    """Read the calibration of two photographs; arguments and errors as in `camera_from_exif`."""
    left, right = camera_from_exif(image0, size0), camera_from_exif(image1, size1)
    return Calibration(left, right, source="EXIF")


def camera_from_exif(image: Any, size: Size) -> Camera:
    """Read the camera of a photograph, which is a file or a PIL image, from its EXIF.

    `size` is (width, height) as `load_image` returns the photograph. The focal length is computed
    from FocalLength and the sensor resolution. If these tags are missing, or the result disagrees
    with FocalLengthIn35mmFilm, it is computed from FocalLengthIn35mmFilm.

    Raises:
        ReconstructionError: there is no usable focal length, or the photograph was cropped later.
    """
    name = file_name(image)
    tags, notes = read_tags(image)
    # Pillow's HEIF plug-in turns images upright and resets the tag. We turn files, not PIL images.
    orientation = notes.get("original_orientation") or tags.get(Base.Orientation, 1)
    turned = is_file(image) and orientation in TRANSPOSED
    own = (size[1], size[0]) if turned else size
    taken = (_number(tags.get(Base.ExifImageWidth)), _number(tags.get(Base.ExifImageHeight)))
    if not min(taken) > 0:
        taken = (float(own[0]), float(own[1]))
    if abs(own[0] * taken[1] / (own[1] * taken[0]) - 1) > MAX_ASPECT_DIFFERENCE:
        raise ReconstructionError(
            f"{name} was cropped after it was taken ({taken[0]:.0f}x{taken[1]:.0f} by its EXIF), "
            f"so its focal length does not apply: {ADVICE}"
        )
    film = _number(tags.get(Base.FocalLengthIn35mmFilm)) * float(np.hypot(*own)) / DIAGONAL_35MM_MM
    focal = _by_sensor(tags, own[0] / taken[0])
    if focal is None or (film > 0 and abs(focal[0] / film - 1) > MAX_FOCAL_DIFFERENCE):
        focal = (film, film)
    if not min(focal) > 0:
        raise ReconstructionError(f"{name} has no focal length in its EXIF: {ADVICE}")
    return Camera(size, focal[::-1] if turned else focal)


def _by_sensor(tags: dict[int, Any], scale: float) -> tuple[float, float] | None:
    """Return (fx, fy) in px from FocalLength and the sensor resolution, times `scale`, or None."""
    length = _number(tags.get(Base.FocalLength))
    unit = MM_PER_UNIT.get(int(_number(tags.get(Base.FocalPlaneResolutionUnit))) or 2, 0.0)
    across = _number(tags.get(Base.FocalPlaneXResolution))
    down = _number(tags.get(Base.FocalPlaneYResolution)) or across
    if not (length > 0 and unit > 0 and across > 0 and down > 0):
        return None
    return length * across / unit * scale, length * down / unit * scale


def read_tags(image: Any, *directories: IFD) -> tuple[dict[int, Any], dict[str, Any]]:
    """Return the EXIF tags of a file or PIL image, and Pillow's `info` of it, with "size" added.

    The tags of further `directories` of EXIF are added.
    """
    try:
        with open_image(image) if is_file(image) else nullcontext(image) as opened:
            exif, tags = opened.getexif(), dict[int, Any]()
            for part in (exif, *(exif.get_ifd(code) for code in (IFD.Exif, *directories))):
                tags |= part
            return tags, opened.info | {"size": opened.size}
    except Exception:  # Pillow raises many types of errors; broken tags are ignored
        return {}, {}


def _number(value: Any) -> float:
    """Return a finite number above 0, or 0 for any other value."""
    number = number_of(value)
    return number if 0 < number < np.inf else 0.0


def number_of(value: Any) -> float:
    """Return the number that a tag stands for, or NaN."""
    try:
        return float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return np.nan
