"""Whether an image is a panorama or a fisheye picture, for which the geometry of pinholes fails."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from PIL.ExifTags import IFD, Base

from .._shared.errors import ImageError
from .._shared.image_array import Channels
from .._shared.opencv import cv2
from .image import load_image, luma
from .image_file import RAW_SUFFIXES, file_name, is_file, is_path, open_image

XMP_OF_PANORAMAS = re.compile(
    rb"GPano:(?:ProjectionType\s*(?:=\s*[\"']|>)\s*(\w+)|FullPanoWidthPixels)"
)
"""This pattern finds, in XMP, the projection of photo spheres and of panoramas of phones."""

FLAT = ("", "rectilinear", "perspective", "planar", "flat")
"""Names of the projection of a pinhole."""

PANORAMA_OF_IPHONE = 6
"""EXIF CustomRendered of panoramas taken with an iPhone. The standard has only 0 and 1."""

LEVEL = 0.003
"""Edges of an image meet if they differ less than all pairs of columns far apart, and no more than
all but this fraction of neighbouring columns, which leaves out the sharpest vertical lines."""

FAR = (1 / 16, 1 / 8, 1 / 4, 3 / 8, 1 / 2)
"""Distances between columns that are far apart, relative to the width. They begin at 1/16, so that
a plain background at both edges, which is mostly wider, is known to be similar everywhere."""

MAX_LINES = 512
"""At most some this many rows are compared, because more would only take time."""

RIM_SIDE_PX, BLACK = 256, 16
"""An image is reduced to this shorter side before a round rim is looked for. Grey levels up to
BLACK count as black around it, because that is the black of video (ITU-R BT.601)."""

MIN_ROUNDNESS, MIN_DIAMETER, MAX_DIAMETER = 0.97, 0.9, 1.02
"""A round picture fills at least this part of a circle (an octagon fills 0.90). The diameter of the
circle, relative to the shorter side of the image, is between the other two. Chosen by hand."""

VIEWS = "-vf v360={}:h_fov=90:v_fov=90:yaw=0 view.png"
PANORAMA, FISHEYE, DUAL_FISHEYE = (
    *("e:flat", "fisheye:flat:ih_fov=180:iv_fov=180"),
    "dfisheye:flat:ih_fov=190:iv_fov=190",
)
"""Projections of ffmpeg's filter v360; its fields of view are in degrees, those of most lenses."""

ROUND = (
    "is a round picture on black, as a fisheye takes it, which no pinhole geometry fits: cut it "
    f"into pinhole views, such as by ffmpeg -i IMAGE {VIEWS.format(FISHEYE)}"
)


def load_pinhole(image: Any, channels: Channels = "rgb", *, rim: bool = False) -> np.ndarray:
    """Load an image as `load_image` does, unless it is that of no pinhole (`why_no_pinhole`)."""
    rgb = load_image(image, channels=channels)
    require_pinhole(image, rgb, rim=rim)
    return rgb


def require_pinhole(image: Any, rgb: np.ndarray, *, rim: bool = True) -> None:
    """Raise an ImageError if an image is that of no pinhole; arguments as in `why_no_pinhole`."""
    if reason := why_no_pinhole(image, rgb, rim=rim):
        raise ImageError(f"{file_name(image)} {reason}")


def why_no_pinhole(image: Any, rgb: np.ndarray | None, *, rim: bool = True) -> str | None:
    """Return what an image is and what to do, if it is a panorama or a fisheye picture.

    `rgb` (H, W, 3) are its pixels; without them, only its metadata count. With `rim`, a round
    picture on black is that of a fisheye. A plane seen through an eyepiece looks the same.
    """
    projection, lens, partial = _metadata(image)
    if partial:
        return "is a panorama by its metadata: give the photographs that it was made of"
    cut = "which no pinhole geometry fits: cut it into pinhole views, such as by ffmpeg -i "
    cut += f"{file_name(image) if is_path(image) else 'IMAGE'} {VIEWS}"
    gray = None if rgb is None else luma(rgb)
    if projection == "equirectangular":
        return f"is a full panorama by its metadata, {cut.format(PANORAMA)}"
    if projection not in FLAT:
        return f"has the projection {projection} by its metadata: convert it to rectilinear first"
    if "fisheye" in re.sub(r"[\W_]", "", lens.lower()):
        return f"was taken with the fisheye {lens}, {cut.format(FISHEYE)}"
    if gray is not None and edges_meet(gray):
        return (
            f"is of 2:1 and its left and right edges meet: a full panorama, {cut.format(PANORAMA)}"
        )
    if gray is not None and rim:
        if is_round(gray):
            return ROUND.replace("IMAGE", file_name(image) if is_path(image) else "IMAGE")
        if gray.shape[1] == 2 * gray.shape[0] and all(map(is_round, np.split(gray, 2, axis=1))):
            return f"shows both pictures of a 360 degree camera, {cut.format(DUAL_FISHEYE)}"
    return None


def edges_meet(gray: np.ndarray) -> bool:
    """Return whether an (H, W) image is a full equirectangular panorama by its edges.

    It is twice as wide as high, and continues from its right edge to the left one, and over each
    pole, which is an edge, to the meridian at half a turn.
    """
    height, width = gray.shape
    if width != 2 * height:
        return False
    rows = gray[:: max(1, height // MAX_LINES)].astype(np.float32)
    contrast = np.maximum(np.abs(rows - rows.mean(axis=0)).mean(axis=0), 1e-6)

    def unlike(lag: int) -> np.ndarray:
        """Return differences relative to the contrast, so that plain columns are not alike."""
        differences = (
            np.abs(rows[:, lag:] - rows[:, :-lag]).mean(axis=0) + 1
        )  # grey level: rounding
        return np.asarray(differences / np.minimum(contrast[lag:], contrast[:-lag]))

    seam = unlike(width - 1)[0]
    far = np.hstack([unlike(int(width * part)) for part in FAR])
    if seam > np.quantile(unlike(1), 1 - LEVEL) or seam >= far.min():
        return False
    near_pole = 2 + int(height * FAR[0])
    for part in (gray[:near_pole], gray[: -near_pole - 1 : -1]):
        values = part.astype(np.float32)
        over_pole = np.abs(values[0] - np.roll(values[0], width // 2)).mean()
        if over_pole > np.abs(values[2:] - values[:-2]).mean(axis=1).max():
            return False
    return True


def is_round(gray: np.ndarray) -> bool:
    """Return whether an (H, W) image is black outside a circle that just fits into it."""
    height, width = gray.shape
    corners = gray[:: height - 1, :: width - 1]
    if corners.max() > BLACK:
        return False
    scale = RIM_SIDE_PX / min(height, width)
    small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    lit = cv2.findNonZero((small > BLACK).astype(np.uint8))
    if lit is None:
        return False
    hull = cv2.convexHull(lit)
    _, radius = cv2.minEnclosingCircle(hull)
    diameter = 2 * radius / min(small.shape)
    filled = cv2.contourArea(hull) / (np.pi * max(radius, 1.0) ** 2)
    return bool(MIN_DIAMETER <= diameter <= MAX_DIAMETER and filled >= MIN_ROUNDNESS)


def _metadata(image: Any) -> tuple[str, str, bool]:
    """Read an image's projection, its lens, and whether it is a part of a panorama or an iPhone's.

    What is unknown is empty.
    """
    if not is_file(image) or file_name(image).lower().endswith(RAW_SUFFIXES):
        return "", "", False
    try:
        with open_image(image) as opened:
            tags, xmp = dict(opened.getexif().get_ifd(IFD.Exif)), opened.info.get("xmp") or b""
            width, height = opened.size
    except Exception:  # Pillow raises many types of errors; broken tags are ignored
        return "", "", False
    lens = " ".join(str(tags.get(tag, "")).strip("\0 ") for tag in (Base.LensMake, Base.LensModel))
    found = XMP_OF_PANORAMAS.findall(xmp if isinstance(xmp, bytes) else xmp.encode())
    projection = max(found, default=b"").decode().lower()
    if found and not projection:
        projection = "equirectangular"
    partial = projection in ("equirectangular", "cylindrical") and width != 2 * height
    return projection, lens.strip(), partial or tags.get(Base.CustomRendered) == PANORAMA_OF_IPHONE
