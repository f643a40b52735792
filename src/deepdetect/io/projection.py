"""Recognise panoramas and fisheye pictures, which no pinhole geometry fits."""

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

ROWS, DETAIL, FAR, MARGIN = 256, 31, 16, 1.3
"""A panorama's first and last column differ MARGIN times less than either differs from any column
1 / FAR of the width or more away, and than columns mirrored at the middle differ. ROWS rows are
compared, minus the mean of DETAIL rows. Chosen on 50 panoramas of rendered rooms. One of
3,222 photographs cut to 2:1 or wider is mistaken for a panorama: a mirrored banner."""

SIDE_PX, BLACK, PLAIN, RIM, MAX_DARK, ROUNDNESS, MAX_CUT = 128, 16, 8, 2, 48, (0.97, 0.92), 16 / 9
"""A round fisheye picture is sought in the image reduced to a shorter side of SIDE_PX. Its pixels
differ from the corners by over BLACK grey levels. Corners are up to MAX_DARK (noise) or, like all
pixels over RIM px outside the circle, vary by up to PLAIN. The picture fills ROUNDNESS[0] of a disc
(octagons: 0.90), each of two ROUNDNESS[1], and is 1 to MAX_CUT shorter sides wide. Set by hand."""

VIEWS = "cut it into pinhole views: ffmpeg -i {} -vf v360={}:h_fov=90:v_fov=90 view.png"


def require_pinhole(
    image: Any, rgb: np.ndarray | None, *, rim: bool = True, name: str = "IMAGE"
) -> None:
    """Raise an ImageError if an image is a panorama or a fisheye picture.

    `rgb` (H, W, 3) are its pixels; if None, only its metadata are examined. If `rim`, a round
    picture on plain ground counts as a fisheye picture, although a photograph through an eyepiece
    looks the same. The message calls an image that is not a file `name`.
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
    if width < max(MIN_ASPECT * height, FAR):
        return False
    few, size = gray[:: max(1, height // (2 * ROWS))], (min(2 * ROWS, width), min(ROWS, height))
    values = cv2.resize(few, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    values -= cv2.blur(values, (1, DETAIL))
    values = np.sign(values) * np.sqrt(np.abs(values))  # limits the weight of strong contrasts
    values /= np.sqrt((values**2).sum(axis=0) + len(values) / 12)  # 1/12: variance of rounding
    far = size[0] // FAR
    mirrored = (values * values[:, ::-1]).sum(axis=0)[far // 2 : (size[0] - far) // 2]
    alike = max((values[:, [0, -1]].T @ values[:, far:-far]).max(), mirrored.max())
    return bool(MARGIN * (1 - values[:, 0] @ values[:, -1]) < 1 - alike)


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
    """Return whether an (H, W) image is plain outside a circle, which two image edges may cut.

    If `beside` is 1, the image is half of a picture of two circles: the other may reach into it.
    """
    scale = SIDE_PX / min(gray.shape)
    small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(int)
    ground = small[[0, 0, -1, -1], [0, -1, 0, -1]]
    apart = np.maximum(small - ground.max(), ground.min() - small)
    other = np.argwhere(apart > BLACK)[:, ::-1].astype(np.int32)
    if not len(other):
        return False
    hull = cv2.convexHull(other)
    (x, y), radius = cv2.minEnclosingCircle(hull)
    beyond = np.hypot(*(np.indices(small.shape) - np.reshape((y, x), (2, 1, 1)))) - radius
    plain = ground.max() <= MAX_DARK or np.ptp(ground) + apart[beyond > RIM].max(initial=0) <= PLAIN
    filled = cv2.fillConvexPoly(np.zeros(small.shape, np.uint8), hull, 1).sum()
    spare = 2 * (1 - ROUNDNESS[0])
    least, most = (1 - spare) * SIDE_PX, (1 + spare) * min(max(small.shape), MAX_CUT * SIDE_PX)
    full = filled >= ROUNDNESS[beside] * (beyond <= 0).sum()
    return bool(plain and full and least <= 2 * radius <= most)
