"""Pairs rendered from photographs: planes, facades, hard views, overlays, frames and strips.

The seed of a pair's random generator consists of the number of the pair's family and its number
within the family.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from itertools import combinations
from pathlib import Path

import numpy as np

from deepdetect._shared.opencv import cv2
from deepdetect.io.image import load_image

from ...datasets.planar import load_oxford
from ...datasets.posed_images import PosedPair, load_posed_scenes
from ..metrics.pose import rotation_error
from .pairs import ROWS, UNRELATED, Images, JudgedPair, Truth

PLANES, FACADES, HARD, OVERLAYS, FRAMES, STRIPS = 60, 90, 200, 60, 30, 40
"""Numbers of pairs to render in each family. Chosen by hand."""

SIZE, NOISE = (720, 600), 3.0
"""Width and height of synthetic images in pixels, and standard deviation of their noise in grey
levels. A phone's photographs taken indoors have about this noise."""

SHARES, ASPECTS, MIN_ROTATION_DEG = (0.1, 0.2, 0.4), (6, 8, 12, 16), 5.0
"""Planes and overlays cover one of the fractions `SHARES` of the image. Strips are `ASPECTS` times
as wide as high. Frames are laid on pairs whose cameras rotated by more than `MIN_ROTATION_DEG`, so
that a pose without rotation, which fits the still frame, is clearly wrong. Chosen by hand."""


class Photographs:
    """The photographs of a data folder from which synthetic pairs are rendered."""

    def __init__(self, data: Path) -> None:
        self.data = data
        self.planes = sorted(data.glob("oxford/*/img1.*"))
        self.scenes = sorted(data.glob("middlebury/*/left.png"))
        self.others = sorted(data.glob("foreground/*.jpg"))
        self.exposures = [sorted(folder.glob("*.png")) for folder in sorted(data.glob("hdr/*"))]

    @cached_property
    def posed(self) -> list[PosedPair]:
        """Pairs with known cameras, to which `overlays` and `frames` add what stands still."""
        return [pair for scene in load_posed_scenes(self.data) for pair in scene.pairs]

    def any(self, rng: np.random.Generator, size: tuple[int, int] = SIZE) -> np.ndarray:
        """Return a random photograph from the list `others`, scaled to `size` (width, height)."""
        return resized(load_image(self.others[rng.integers(len(self.others))]), size)

    def unlike(self, rng: np.random.Generator) -> list[np.ndarray]:
        """Return two different photographs from the list `others`, scaled to `SIZE`."""
        two = rng.choice(len(self.others), 2, replace=False)
        return [resized(load_image(self.others[number]), SIZE) for number in two]


def resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return a copy of an image, resized to (width, height)."""
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def corners(width: float, height: float) -> np.ndarray:
    """Return the (4, 2) corners of a rectangle that begins at the origin."""
    return np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)


def moved_corners(rng: np.random.Generator, size: tuple[int, int], by: float) -> np.ndarray:
    """Return a homography that moves each image corner at random by up to `by` times the height."""
    outline = corners(*size)
    moved = outline + rng.uniform(-by, by, (4, 2)) * size[1]
    return np.asarray(cv2.getPerspectiveTransform(outline, moved.astype(np.float32)))


def noisy(image: np.ndarray, rng: np.random.Generator, gain: float = 1.0) -> np.ndarray:
    """Multiply an image by a gain, and add the noise of a sensor."""
    values = image.astype(np.float32) * gain + rng.normal(0, NOISE, image.shape)
    return np.asarray(np.clip(values, 0, 255).astype(np.uint8))


def planes(data: Path) -> Iterator[JudgedPair]:
    """Yield pairs of views of a plane in front of unrelated images or of a scene with depth."""
    photographs = Photographs(data)
    for number in range(PLANES):
        share, rectified = SHARES[number % 3], number % 2 == 1
        rest = "a scene with depth" if rectified else "unrelated"
        images, homography, mask = _plane(photographs, number, share, rectified)
        truth = Truth(homography, mask, ROWS if rectified else None)
        yield _made(f"plane of {share:.0%}, the rest {rest}", number, images, truth)


def _made(kind: str, number: int, images: Images, truth: Truth) -> JudgedPair:
    return JudgedPair(kind, str(number), lambda: images, truth)


def _plane(
    photographs: Photographs, number: int, share: float, rectified: bool
) -> tuple[Images, np.ndarray, np.ndarray]:
    """Render a plane into two views; return both, its homography and its mask in the first view."""
    rng = np.random.default_rng([0, number])
    texture = load_image(photographs.planes[rng.integers(len(photographs.planes))])
    if rectified:
        left = photographs.scenes[rng.integers(len(photographs.scenes))]
        views = [resized(load_image(left.with_name(f"{s}.png")), SIZE) for s in ("left", "right")]
    else:
        views = photographs.unlike(rng)
    side = float(np.sqrt(share * SIZE[0] * SIZE[1]))
    size = np.array([1.15 * side, side / 1.15])
    texture = resized(texture, (round(size[0]), round(size[1])))
    outline, placed, masks = corners(*size), [], []
    for view in views:
        moved = outline + rng.uniform(0, 1, 2) * (np.array(SIZE) - size)
        moved = (moved + rng.uniform(-0.07, 0.07, (4, 2)) * side).clip(0, np.array(SIZE) - 1)
        placed.append(cv2.getPerspectiveTransform(outline, moved.astype(np.float32)))
        whole = np.ones(texture.shape[:2], np.uint8)
        masks.append(cv2.warpPerspective(whole, placed[-1], SIZE) > 0)
        view[masks[-1]] = cv2.warpPerspective(texture, placed[-1], SIZE)[masks[-1]]
    return (views[0], views[1]), placed[1] @ np.linalg.inv(placed[0]), masks[0]


def facades(data: Path) -> Iterator[JudgedPair]:
    """Yield pairs of views of a facade with equal windows, the second one window farther right.

    Therefore nothing seems to have moved. The facade is alone, or surrounded by unrelated content,
    or has a unique window and surroundings that both images show. Only pairs of the last kind can
    be matched correctly.
    """
    photographs = Photographs(data)
    kinds = "facade alone", "facade between unrelated things", "facade with what occurs once"
    for number in range(FACADES):
        which, tilted = number % 3, number % 9 >= 6
        images, homography = _facade(photographs, number, which, 0.2 if tilted else 0.05)
        kind = f"{kinds[which]}{', tilted' if tilted else ''}"
        yield _made(kind, number, images, Truth(homography))


def _facade(
    photographs: Photographs, number: int, which: int, tilt: float
) -> tuple[Images, np.ndarray]:
    rng = np.random.default_rng([1, number])
    columns, rows = int(rng.integers(5, 9)), int(rng.integers(3, 6))
    part = 1.0 if which == 0 else 0.75
    period = np.array([int(part * SIZE[0] / (columns - 1)), int(part * SIZE[1] / rows)])
    inner = (0.7 * period).astype(int)
    top, left = (period - inner)[::-1] // 2
    texture = load_image(photographs.planes[rng.integers(len(photographs.planes))])
    side = min(texture.shape[:2]) // 2
    y, x = rng.integers(0, np.array(texture.shape[:2]) - side)
    window = resized(texture[y : y + side, x : x + side], tuple(inner.tolist()))
    cell = cv2.GaussianBlur(photographs.any(rng, tuple(period.tolist())), (0, 0), 3)
    cell[top : top + inner[1], left : left + inner[0]] = window
    facade = np.tile(cell, (rows + 1, columns + 2, 1))
    if which == 2:
        row, column = rng.integers(rows), rng.integers(1, columns - 1)
        y, x = row * period[1] + top, column * period[0] + left
        facade[y : y + inner[1], x : x + inner[0]] = photographs.any(rng, tuple(inner.tolist()))
    width, height = (columns * period[0], rows * period[1])
    around = photographs.any(rng, (SIZE[0] + int(period[0]), SIZE[1]))
    unlike = photographs.unlike(rng) if which == 1 else []
    views, placed = [], []
    for view in range(2):
        start = view * period[0]
        if which == 0:
            canvas = facade[period[1] // 2 :, period[0] // 2 + start :][: SIZE[1], : SIZE[0]]
            missing = SIZE[1] - canvas.shape[0], SIZE[0] - canvas.shape[1]
            canvas = np.pad(canvas, [(0, missing[0]), (0, missing[1]), (0, 0)], "symmetric")
        elif which == 1:
            canvas = unlike[view]
            left = min(50, SIZE[0] - width)
            canvas[60 : 60 + height, left : left + width] = facade[:height, start:][:, :width]
        else:
            whole = np.array(around)
            whole[60 : 60 + height, 90 : 90 + width] = facade[:height, :width]
            canvas = whole[:, start : start + SIZE[0]]
        seen = moved_corners(rng, SIZE, tilt)
        warped = cv2.warpPerspective(canvas, seen, SIZE)
        views.append(noisy(warped, rng, rng.uniform(0.85, 1.15)))
        shift = np.eye(3)
        shift[0, 2] = -start
        placed.append(seen @ shift)
    return (views[0], views[1]), placed[1] @ np.linalg.inv(placed[0])


def hard_views(data: Path) -> Iterator[JudgedPair]:
    """Yield pairs of a photograph and its view from the side, from afar, or in other tones."""
    photographs = Photographs(data)
    for number in range(HARD):
        kind = ("seen from the side", "seen from the side", "zoomed", "other tones")[number % 4]
        images, homography = _hard_view(photographs, number, kind)
        yield _made(kind, number, images, Truth(homography))


def _hard_view(photographs: Photographs, number: int, kind: str) -> tuple[Images, np.ndarray]:
    rng = np.random.default_rng([2, number])
    image = resized(load_image(photographs.planes[rng.integers(len(photographs.planes))]), SIZE)
    centre = np.array(SIZE) / 2
    to_centre, back, change = np.eye(3), np.eye(3), np.eye(3)
    to_centre[:2, 2], back[:2, 2] = -centre, centre
    shorter, factor = rng.uniform(2, 6), rng.uniform(2, 6)
    if kind == "seen from the side":
        turn = cv2.getRotationMatrix2D((0, 0), rng.uniform(0, 180), 1)[:, :2]
        change[:2, :2] = turn.T @ np.diag([1 / shorter, 1]) @ turn
        blur = 0.8 * (shorter**2 - 1) ** 0.5
        turned = np.vstack([np.c_[turn, centre - turn @ centre], [0, 0, 1]])
        across = cv2.warpPerspective(image, turned, SIZE, borderMode=cv2.BORDER_REFLECT_101)
        across = cv2.GaussianBlur(across, (0, 0), sigmaX=blur, sigmaY=0.01)
        how = {"flags": cv2.WARP_INVERSE_MAP, "borderMode": cv2.BORDER_REFLECT_101}
        image1 = cv2.warpPerspective(across, turned, SIZE, **how)
    elif kind == "zoomed":
        change[:2, :2] *= 1 / factor
        image1 = cv2.GaussianBlur(image, (0, 0), 0.5 * (factor**2 - 1) ** 0.5)
    else:
        tones = np.arange(256) / 255
        curve = 1 - tones if number % 8 == 3 else tones ** (4 ** rng.uniform(-1, 1))
        image1 = cv2.LUT(image, np.rint(255 * curve).astype(np.uint8))
    homography = moved_corners(rng, SIZE, 0.03) @ back @ change @ to_centre
    return (image, noisy(cv2.warpPerspective(image1, homography, SIZE), rng)), homography


def overlays(data: Path) -> Iterator[JudgedPair]:
    """Yield image pairs from a moving camera, with an overlay that stands still in the image."""
    photographs = Photographs(data)
    planar = [pair for scene in load_oxford(data / "oxford", "refined") for pair in scene.pairs]
    for number in range(OVERLAYS):
        rng, share = np.random.default_rng([3, number]), SHARES[number % 3]
        if number % 2:
            pair = planar[rng.integers(len(planar))]
            images = load_image(pair.first), load_image(pair.second)
            shape = tuple(np.minimum(images[0].shape, images[1].shape)[:2])
            images = images[0][: shape[0], : shape[1]], images[1][: shape[0], : shape[1]]
        else:
            seen = photographs.posed[rng.integers(len(photographs.posed))]
            images = load_image(seen.first.path), load_image(seen.second.path)
        mask = _overlay(rng, images[0].shape[:2], share)
        texture = photographs.any(rng, images[0].shape[1::-1])
        both = [np.where(mask[..., None], noisy(texture, rng), image) for image in images]
        truth = Truth(pair.homography, ~mask) if number % 2 else Truth(posed=seen, by_pose=True)
        yield _made(f"overlay of {share:.0%}", number, (both[0], both[1]), truth)


def _overlay(rng: np.random.Generator, shape: tuple[int, ...], share: float) -> np.ndarray:
    """Return the mask of an overlay: a car's bonnet, strips of text, or a picture in a picture."""
    height, width = shape
    mask = np.zeros(shape, np.uint8)
    kind = rng.integers(3)
    if kind == 0:
        middle, axes = (width // 2, height), (round(0.7 * width), round(1.1 * share * height))
        cv2.ellipse(mask, middle, axes, 0, 180, 360, 1, -1)
    elif kind == 1:
        mask[: round(share * height / 2)] = 1
        mask[height - round(share * height / 2) :] = 1
    else:
        side = np.sqrt(share)
        y, x = (rng.uniform(0, 1 - side, 2) * shape).astype(int)
        mask[y : y + round(side * height), x : x + round(side * width)] = 1
    return mask > 0


def frames(data: Path) -> Iterator[JudgedPair]:
    """Yield image pairs from a rotating camera in black frames: letter boxes, lenses or scans."""
    pairs = [
        pair
        for pair in Photographs(data).posed
        if rotation_error(np.eye(3), pair.rotation) > MIN_ROTATION_DEG
    ]
    for number in range(FRAMES):
        rng = np.random.default_rng([4, number])
        pair = pairs[rng.integers(len(pairs))]
        images = load_image(pair.first.path), load_image(pair.second.path)
        height, width = images[0].shape[:2]
        shown, kind = np.zeros((height, width), np.uint8), number % 3
        at = rng.uniform(0.05, 0.12)
        if kind == 0:
            shown[round(at * height) : round((1 - at) * height)] = 1
        elif kind == 1:
            axes = width // 2, round(0.6 * height)
            cv2.ellipse(shown, (width // 2, height // 2), axes, 0, 0, 360, 1, -1)
        else:
            top, left = round(at * height), round(at * width)
            shown[top : height - top, left : width - left] = 1
        kinds = "letter box", "round lens", "border of a scan"
        both = images[0] * shown[..., None], images[1] * shown[..., None]
        yield _made(f"frame, {kinds[kind]}", number, both, Truth(posed=pair, by_pose=True))


def strips(data: Path) -> Iterator[JudgedPair]:
    """Yield pairs of long strips in different light, cut from photographs and from exposures."""
    photographs = Photographs(data)
    exposed = [pair for folder in photographs.exposures for pair in combinations(folder, 2)]
    for number in range(STRIPS):
        rng, aspect = np.random.default_rng([5, number]), ASPECTS[number % 4]
        if exposed and number % 2:
            first, second = exposed[rng.integers(len(exposed))]
        else:
            first = second = photographs.posed[rng.integers(len(photographs.posed))].first.path
        images = load_image(first), load_image(second)
        height, width = images[0].shape[:2]
        tall = width // aspect
        top = int(rng.integers(0, height - tall))
        parts = [image[top : top + tall] for image in images]
        homography = moved_corners(rng, (width, tall), 0.2)
        moved = cv2.warpPerspective(parts[1], homography, (width, tall))
        dark, bright = rng.uniform(0.4, 1.4, 2).tolist()
        ramp = np.linspace(dark, bright, width)[None, :, None]
        curve = np.rint(255 * (np.arange(256) / 255) ** (2 ** rng.uniform(-1, 1)))
        lit = noisy(cv2.LUT(moved, curve.astype(np.uint8)) * ramp, rng)
        source = "exposures" if exposed and number % 2 else "photographs"
        yield _made(f"strips of {source}", number, (parts[0], lit), Truth(homography))


def noise(data: Path) -> Iterator[JudgedPair]:
    """Yield pairs of a photograph and a blank image, which has one grey level and noise."""
    photographs = Photographs(data)
    for number in range(len(SHARES) * 4):
        rng = np.random.default_rng([6, number])
        blank = np.full((*SIZE[::-1], 3), rng.integers(0, 256), np.uint8)
        images = photographs.any(rng), noisy(blank, rng)
        yield _made("nothing", number, images, UNRELATED)
