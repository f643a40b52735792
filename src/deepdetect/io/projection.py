"""Whether an image is a panorama or a fisheye picture, which no pinhole geometry fits."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from PIL.ExifTags import IFD, Base

from .._shared.errors import ImageError
from .._shared.opencv import cv2
from .image import luma
from .image_file import RAW_SUFFIXES, file_name, is_file, is_path, open_image

ROWS, SHARPEST, FAR = 512, 0.003, (1 / 16, 1 / 8, 1 / 4, 3 / 8, 1 / 2)
"""Edges meet if they differ less than any two columns at the distances FAR (of the width), and no
more than neighbours without the SHARPEST part, which are outlines of things. A plain background is
mostly wider than 1/16, so that far columns are alike. Some ROWS are compared, because more
take time."""

SIDE_PX, BLACK, ROUNDNESS = 128, 16, 0.97
"""An image is reduced to the shorter side SIDE_PX. If it is round, grey levels outside are up to
BLACK (ITU-R BT.601), it fills at least this part of a circle (an octagon fills 0.90), and its
diameter is the shorter side, to twice what is missing at 1. The last was chosen by hand."""

CUT = "cut it into pinhole views: ffmpeg -i {} -vf v360={}:h_fov=90:v_fov=90:yaw=0 view.png"
PANORAMA, FISHEYE = "e:flat", "fisheye:flat:ih_fov=180:iv_fov=180"


def require_pinhole(image: Any, rgb: np.ndarray | None, *, rim: bool = True) -> None:
    """Raise an ImageError if an image is a panorama or a fisheye picture.

    `rgb` (H, W, 3) are its pixels; without them, only its metadata count. With `rim`, a round
    picture on black is that of a fisheye. A plane seen through an eyepiece looks the same.
    """
    tags, projection, full = _metadata(image)
    lens = f"{tags.get(Base.LensMake, '')} {tags.get(Base.LensModel, '')}"
    gray = np.zeros((1, 1), np.uint8) if rgb is None else luma(rgb)
    how = CUT.format(file_name(image) if is_path(image) else "IMAGE", PANORAMA)
    iphone = tags.get(Base.CustomRendered) == 6  # for panoramas; the standard has only 0 and 1
    if iphone or (projection and not full):
        what, how = "part of a panorama by its metadata", "give the photographs it is made of"
    elif projection or edges_meet(gray):
        what = f"a full panorama ({'by its metadata' if projection else '2:1, and its edges meet'})"
    elif "fisheye" in re.sub(r"[\W_]", "", lens.lower()) or (rim and is_round(gray)):
        what, how = "a fisheye picture (round, or by its EXIF)", how.replace(PANORAMA, FISHEYE)
    else:
        return
    raise ImageError(f"{file_name(image)} is {what}, which no pinhole geometry fits: {how}")


def edges_meet(gray: np.ndarray) -> bool:
    """Return whether an (H, W) image is a full equirectangular panorama by its edges.

    It is twice as wide as high, and continues from its right edge to the left one, and over each
    pole, which is an edge, to the meridian at half a turn.
    """
    height, width = gray.shape
    if width != 2 * height or not gray.any():
        return False
    values = gray[:: max(1, height // ROWS)].astype(np.float32)
    contrast = np.maximum(np.abs(values - values.mean(axis=0)).mean(axis=0), 1e-6)

    def unlike(lag: int) -> np.ndarray:  # relative to the contrast: plain columns are not alike
        differences = np.abs(values[:, lag:] - values[:, :-lag]).mean(axis=0) + 1  # 1: rounding
        return np.asarray(differences / np.minimum(contrast[lag:], contrast[:-lag]))

    far = min(unlike(int(width * part)).min() for part in FAR)
    if not far > unlike(width - 1)[0] <= np.quantile(unlike(1), 1 - SHARPEST):
        return False
    depth = 2 + int(height * FAR[0])
    for rows in (gray[:depth].astype(np.float32), gray[: -depth - 1 : -1].astype(np.float32)):
        steps = np.abs(rows[2:] - rows[:-2]).mean(axis=1)
        if np.abs(rows[0] - np.roll(rows[0], height)).mean() > steps.max():
            return False
    return True


def is_round(gray: np.ndarray) -> bool:
    """Return whether an (H, W) image is black outside a circle that just fits into it."""
    if gray[[0, 0, -1, -1], [0, -1, 0, -1]].max() > BLACK:
        return False
    scale = SIDE_PX / min(gray.shape)
    small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    if small.max() <= BLACK:
        return False
    hull = cv2.convexHull(np.argwhere(small > BLACK).astype(np.int32))
    radius = cv2.minEnclosingCircle(hull)[1]
    fits = abs(2 * radius / SIDE_PX - 1) <= 2 * (1 - ROUNDNESS)
    return bool(fits and cv2.contourArea(hull) >= ROUNDNESS * np.pi * radius**2)


def _metadata(image: Any) -> tuple[dict[int, Any], str, bool]:
    """Read EXIF and the projection of a panorama, "" if there is none, and whether it is 2:1."""
    try:
        if not is_file(image) or file_name(image).lower().endswith(RAW_SUFFIXES):
            return {}, "", False
        with open_image(image) as opened:
            tags, xmp = dict(opened.getexif().get_ifd(IFD.Exif)), opened.info.get("xmp") or b""
            text = xmp if isinstance(xmp, str) else xmp.decode("utf-8", "ignore")
            found = re.search(r"GPano:ProjectionType\W+(?!rectilinear)(\w+)", text)
            return tags, found[1] if found else "", opened.width == 2 * opened.height
    except Exception:  # Pillow raises many types of errors; broken tags are ignored
        return {}, "", False
