"""Pairs of photographs with known geometry, read from the folders of the benchmarks' data sets."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np

from deepdetect._shared.opencv import cv2
from deepdetect.geometry.images import downscale
from deepdetect.io.image import load_image

from ...datasets.planar import load_oxford
from ...datasets.posed_images import load_posed_scenes
from .pairs import ROWS, UNRELATED, Images, JudgedPair, Truth

MIDDLEBURY_SIDES_PX, FAR_FRAMES, SAME_PLACE_PX = (None, 480), range(15, 26, 5), 5.0
"""Middlebury's pairs are matched at their own size and at a longer side of 480 px, at which
thresholds in pixels act differently. Pairs of video frames `FAR_FRAMES` apart are a kind of their
own. Images from one webcam or tripod are aligned to within a pixel, but errors below
`SAME_PLACE_PX` count as correct, because clouds and wind move things. Chosen by hand."""


def read(first: Path, second: Path, side_px: int | None = None) -> Images:
    """Read two images, reduced to a longer side of `side_px` unless it is None."""
    images = load_image(first), load_image(second)
    if side_px is None:
        return images
    return downscale(images[0], side_px)[0], downscale(images[1], side_px)[0]


def oxford(data: Path) -> Iterator[JudgedPair]:
    """Yield the pairs of image 1 and each other image of the Oxford scenes."""
    for scene in load_oxford(data / "oxford", "refined"):
        for pair in scene.pairs:
            make = partial(read, pair.first, pair.second)
            yield JudgedPair("oxford", pair.name, make, Truth(pair.homography))


def middlebury(data: Path) -> Iterator[JudgedPair]:
    """Yield rectified pairs of scenes that are not planar, at the sizes `MIDDLEBURY_SIDES_PX`."""
    for left in sorted(data.glob("middlebury/*/left.png")):
        for side in MIDDLEBURY_SIDES_PX:
            kind = f"middlebury, {side or 'native'}"
            make = partial(read, left, left.with_name("right.png"), side)
            yield JudgedPair(kind, left.parent.name, make, Truth(fundamental=ROWS, depth=True))


def posed(data: Path) -> Iterator[JudgedPair]:
    """Yield pairs of scenes with known cameras. An answer with the correct pose is right."""
    for scene in load_posed_scenes(data):
        for pair in scene.pairs:
            far = pair.frame_distance is not None and pair.frame_distance in FAR_FRAMES
            kind = f"{scene.name}, far apart" if far else scene.name
            make = partial(read, pair.first.path, pair.second.path)
            truth = Truth(fundamental=pair.fundamental, posed=pair)
            yield JudgedPair(kind, pair.name, make, truth)


def wide(data: Path) -> Iterator[JudgedPair]:
    """Yield pairs with wide baselines, or in different seasons or light, and hand-marked points."""
    for marked in sorted(data.glob("wide/*/correspondences.txt")):
        first, second = (next(marked.parent.glob(f"{number}.*")) for number in (0, 1))
        places = np.loadtxt(marked).reshape(-1, 4)
        matrix, _ = cv2.findFundamentalMat(places[:, :2], places[:, 2:], cv2.FM_LMEDS)
        truth = Truth(fundamental=matrix, right_px=10.0)  # hand-made marks are off by pixels
        make = partial(read, first, second)
        yield JudgedPair("wide", marked.parent.name, make, truth, places)


def webcams(data: Path) -> Iterator[JudgedPair]:
    """Yield all pairs of photographs of the same webcam, in different light, season and weather."""
    yield from _from_one_place("webcams", data.glob("webcams/*"), "*.jpg")


def exposures(data: Path) -> Iterator[JudgedPair]:
    """Yield all pairs of different exposures from the same tripod."""
    yield from _from_one_place("exposures", data.glob("hdr/*"), "*.png")


def _from_one_place(kind: str, folders: Iterable[Path], pattern: str) -> Iterator[JudgedPair]:
    for folder in sorted(folders):
        for first, second in combinations(sorted(folder.glob(pattern)), 2):
            name = f"{folder.name} {first.stem}-{second.stem}"
            truth = Truth(np.eye(3), right_px=SAME_PLACE_PX)
            yield JudgedPair(kind, name, partial(read, first, second), truth)


def unrelated(data: Path) -> Iterator[JudgedPair]:
    """Yield all pairs of photographs of different things."""
    places = [*sorted(data.glob("oxford/*/img1.*")), *sorted(data.glob("middlebury/*/left.png"))]
    things = sorted(data.glob("foreground/*.jpg"))
    others = zip(things, [*things[1:], *things[:1]], strict=True)
    for first, second in (*combinations(places, 2), *others):
        name = f"{first.parent.name} {first.stem}-{second.parent.name} {second.stem}"
        yield JudgedPair("unrelated", name, partial(read, first, second), UNRELATED)
