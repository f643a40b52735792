"""Render the second image of the app's example of forward motion.

    python tools/forward_example.py

The image shows the left view of the motorcycle (Middlebury 2014, in scikit-image) as seen from a
camera that moved forward. Each pixel moves according to its true depth. Empty pixels are inpainted.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from deepdetect.io.picture_file import save_picture
from deepdetect_lab.datasets import load_motorcycle

OUTPUT = Path("src/deepdetect/app/static/examples/motorcycle-ahead.jpg")

AHEAD = 0.16
"""The camera moves forward by this fraction of the depth of the nearest point. Chosen by hand."""

FOCAL_PX, CENTRE, OFFSET_PX = 994.978, (311.193, 254.877), 31.086
"""Middlebury's calibration at the size of the pair, in pixels: focal length and principal point of
the left camera, and difference of the two cameras' cx."""

SCALE = 4
"""The image is enlarged by this factor before pixels are moved, so that magnified parts have no
gaps. Chosen by hand."""


def main() -> None:
    """Write the image."""
    pair = load_motorcycle()
    unknown = np.isnan(pair.disparity).astype(np.uint8)
    known_ones = np.nan_to_num(pair.disparity).astype(np.float32)
    levels = cv2.inpaint(known_ones, unknown, 3, cv2.INPAINT_NS)
    height, width = levels.shape
    size = width * SCALE, height * SCALE
    rgb = cv2.resize(pair.left, size, interpolation=cv2.INTER_CUBIC)
    depth = 1 / (cv2.resize(levels, size, interpolation=cv2.INTER_NEAREST) + OFFSET_PX)
    nearer = depth - AHEAD * depth.min()
    y, x = np.mgrid[: size[1], : size[0]] / SCALE
    xy = [np.rint((v - c) * depth / nearer + c) for v, c in zip((x, y), CENTRE, strict=True)]
    column, row = (each.astype(int) for each in xy)
    seen = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    order = np.argsort(-nearer[seen])  # the nearest come last and overwrite the others
    picture, known = np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.uint8)
    picture[row[seen][order], column[seen][order]] = rgb[seen][order]
    known[row[seen], column[seen]] = 1
    save_picture(cv2.inpaint(picture, 1 - known, 3, cv2.INPAINT_TELEA), OUTPUT)
    print(f"{OUTPUT}: {1 - known.mean():.1%} inpainted")


if __name__ == "__main__":
    main()
