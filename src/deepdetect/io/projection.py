"""Whether an image is a panorama or a fisheye picture, which no pinhole geometry fits."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from PIL.ExifTags import Base

from .._shared.errors import ImageError
from .._shared.opencv import cv2
from .exif import read_tags
from .image import luma
from .image_file import RAW_SUFFIXES, file_name, is_path

MIN_ASPECT, MAX_ASPECT = 1.95, 2.05
"""A panorama of 360 degrees is at least MIN_ASPECT times as wide as high. Up to MAX_ASPECT, it is
equirectangular (2:1, with a margin for resizing); a wider one may be cylindrical."""

ROWS, SHARPEST, FAR, MARGIN = 512, 0.003, (1 / 16, 1 / 8, 1 / 4, 3 / 8, 1 / 2), 1.5
"""Left and right edges meet if they differ MARGIN times less than any two columns at the distances
FAR (fractions of the width), and no more than neighbouring columns, except the fraction SHARPEST of
these (outlines). FAR begins with 1/16, because most plain backgrounds, whose columns are all alike,
are wider. About ROWS rows are compared, to save time. The ratio that MARGIN limits is at least 1.5
for 6 panoramas, and at most 1.4 for 2,163 photographs cut to 2:1."""

SIDE_PX, BLACK, MAX_DARK, ROUNDNESS, MAX_CUT = 128, 16, 48, (0.97, 0.92), 16 / 9
"""Fisheye circles are sought in images reduced to a shorter side of SIDE_PX. The corners have
up to MAX_DARK grey levels (noise of cheap cameras), the circle over BLACK more (ITU-R BT.601). It
fills ROUNDNESS[0] of a disc (an octagon fills 0.90), or ROUNDNESS[1] if two are side by side. Its
diameter is 1 to MAX_CUT times the shorter side (a video of full width). Chosen by hand."""

VIEWS = "cut it into pinhole views: ffmpeg -i {} -vf v360={}:h_fov=90:v_fov=90 view.png"


def require_pinhole(
    image: Any, rgb: np.ndarray | None, *, rim: bool = True, name: str = "IMAGE"
) -> None:
    """Raise an ImageError if an image is a panorama or a fisheye picture.

    `rgb` (H, W, 3) are its pixels; if None, only its metadata are examined. If `rim`, a round
    picture on black counts as a fisheye picture, although a plane seen through an eyepiece looks
    the same. The message calls an image that is not a file `name`.
    """
    raw = file_name(image).lower().endswith(RAW_SUFFIXES)
    tags, notes = ({}, {}) if raw else read_tags(image)
    xmp = notes.get("xmp") or b""
    xmp = xmp if isinstance(xmp, str) else xmp.decode("utf-8", "ignore")
    projection = re.search(r"GPano:ProjectionType\W+(?!rectilinear)\w", xmp)
    lens = f"{tags.get(Base.LensMake, '')} {tags.get(Base.LensModel, '')}"
    gray = np.zeros((1, 1), np.uint8) if rgb is None else luma(rgb)
    width, height = notes.get("size") or gray.shape[::-1]
    sphere = MIN_ASPECT * height <= width <= MAX_ASPECT * height
    photographs = "give the photographs it is made of"
    form, how = "e:flat", VIEWS if sphere else photographs
    if tags.get(Base.CustomRendered) == 6 or (projection and not sphere):  # 6: iPhones' panoramas
        what, how = "part of a panorama by its metadata", photographs
    elif projection or edges_meet(gray):
        what = f"a full panorama ({'by its metadata' if projection else 'its edges meet'})"
    elif is_cube_map(gray):
        what, how = "a cube map", "give its six faces"
    elif "fisheye" in re.sub(r"[\W_]", "", lens.lower()) or (rim and is_round(gray)):
        what = "a fisheye picture (round, or by its EXIF)"
        form, how = "fisheye:flat:ih_fov=180:iv_fov=180", VIEWS
    elif rim and all(is_round(half, 1) for half in np.array_split(gray, 2, axis=1)):
        what, form, how = "two fisheye pictures side by side", "dfisheye:flat", VIEWS
    else:
        return
    name = file_name(image) if is_path(image) else name
    raise ImageError(f"{name} is {what}, which no pinhole geometry fits: {how.format(name, form)}")


def edges_meet(gray: np.ndarray) -> bool:
    """Return whether an (H, W) image is wide and continues from its right edge to the left one."""
    height, width = gray.shape
    if width < MIN_ASPECT * height or not gray.any():
        return False
    values = gray[:: max(1, height // ROWS)].astype(np.float32)
    contrast = np.maximum(np.abs(values - values.mean(axis=0)).mean(axis=0), 1e-6)

    def unlike(lag: int) -> np.ndarray:  # relative to the contrast: plain columns are not alike
        differences = np.abs(values[:, lag:] - values[:, :-lag]).mean(axis=0) + 1  # 1: rounding
        return np.asarray(differences / np.minimum(contrast[lag:], contrast[:-lag]))

    far = min(unlike(int(width * part)).min() for part in FAR)
    seam = unlike(width - 1)[0]
    return bool(MARGIN * seam < far and seam <= np.quantile(unlike(1), 1 - SHARPEST))


def is_cube_map(gray: np.ndarray) -> bool:
    """Return whether an (H, W) image is a cross of six squares on a plain ground."""
    if len(gray) > gray.shape[1]:
        gray = gray.T
    side = len(gray) // 3
    if not side or gray.shape != (3 * side, 4 * side):
        return False
    cells = gray.reshape(3, side, 4, side)
    plain = np.ptp(cells, axis=(1, 3)) <= BLACK
    return bool(not plain[1].any() and (plain[0] == plain[2]).all() and plain[0].sum() == 3)


def is_round(gray: np.ndarray, beside: int = 0) -> bool:
    """Return whether an (H, W) image is dark outside a circle, which two image edges may cut.

    If `beside` is 1, the image is half of a picture of two circles: the other may reach into it.
    """
    scale = SIDE_PX / min(gray.shape)
    small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    dark = int(small[[0, 0, -1, -1], [0, -1, 0, -1]].max())
    bright = np.argwhere(small > dark + BLACK)[:, ::-1].astype(np.int32)
    if dark > MAX_DARK or not len(bright):
        return False
    hull = cv2.convexHull(bright)
    (x, y), radius = cv2.minEnclosingCircle(hull)
    rows, columns = np.indices(small.shape)
    disc = np.hypot(columns - x, rows - y) <= radius
    filled = cv2.fillConvexPoly(np.zeros(small.shape, np.uint8), hull, 1)
    spare = 2 * (1 - ROUNDNESS[0])
    least, most = (1 - spare) * SIDE_PX, (1 + spare) * min(max(small.shape), MAX_CUT * SIDE_PX)
    return bool(least <= 2 * radius <= most and filled.sum() >= ROUNDNESS[beside] * disc.sum())
