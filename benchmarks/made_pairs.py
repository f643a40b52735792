"""How often matches of each confidence are wrong, for real and for synthetic pairs.

    python benchmarks/made_pairs.py DATA [--only photographs|planes|refusal|hard] [--every N]

DATA contains oxford, middlebury, foreground, and the scenes of `deepdetect dev benchmark pose`. The
table has a line for each kind of pair: the number of pairs, the numbers answered with high and with
fair confidence, and how many of these answers are wrong. An answer is wrong if fewer than half of
its matches are correct and its pose is wrong. (Matches alone do not suffice: in images from a
moving car the ground-truth epipolar lines are off by pixels.) The kinds are:

- photographs: all pairs with known ground truth;
- planes: two views of one photograph, which covers 10, 20 or 40 % of both images; the rest is
  unrelated, or a rectified pair of a scene with depth;
- refusal: unrelated photographs, and facades with one repeated window. The second image of a facade
  begins a window later, so that nothing seems to have moved. The facade is alone, or surrounded by
  unrelated content, or has one unique window and surroundings that both images show. Only pairs of
  the last kind can be answered.
- hard: views from the side, from a larger distance, or with other tones.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, islice
from pathlib import Path

import numpy as np

from deepdetect import DeepDetect, match_images
from deepdetect._shared.opencv import cv2
from deepdetect.geometry.transforms import epipolar_errors, transfer_errors
from deepdetect.io.image import load_image
from deepdetect_lab.datasets.planar import load_oxford
from deepdetect_lab.datasets.posed_images import PosedPair, load_posed_scenes
from deepdetect_lab.evaluation.protocols.pose import ERROR, GOOD_DEG, estimate_pose, pose_errors

PAIRS = 60
"""Numbers of synthetic pairs of planes and of facades. The index of a pair is its seed."""

HARD_PAIRS = 200
"""Number of synthetic pairs of views that differ much."""

SIZE = (720, 600)
"""Width and height of synthetic images in pixels."""

RIGHT_PX = 3.0
"""A correct match has a smaller transfer error on a plane, or distance to its epipolar line
otherwise. Chosen by hand."""

ROWS = np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0.0]])
"""Fundamental matrix of a rectified pair."""

NOISE = 3.0
"""Standard deviation of the noise of synthetic images, in grey levels. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class MadePair:
    """Two images and their ground truth.

    Inside the (H, W) bool mask it is the (3, 3) homography, outside the (3, 3) fundamental matrix.
    Without that, matches outside the mask are wrong.
    """

    kind: str
    images: tuple[np.ndarray, np.ndarray]
    homography: np.ndarray
    mask: np.ndarray
    fundamental: np.ndarray | None = None
    posed: PosedPair | None = None

    def right(self, points0: np.ndarray, points1: np.ndarray) -> np.ndarray:
        """Return which of (M, 2) matches are correct, (M,) bool."""
        x, y = np.rint(points0).astype(np.int64).T
        right = self.mask[y, x] & (transfer_errors(points0, points1, self.homography) < RIGHT_PX)
        if self.fundamental is None:
            return right
        near = epipolar_errors(points0, points1, self.fundamental) < RIGHT_PX
        return np.where(self.mask[y, x], right, near)

    def is_right(self, points0: np.ndarray, points1: np.ndarray) -> bool:
        """Return whether at least half of the matches are correct, or else their pose."""
        half = bool(self.right(points0, points1).mean() >= 0.5)
        if half or self.posed is None:
            return half
        cameras = self.posed.first.intrinsics, self.posed.second.intrinsics
        pose = estimate_pose(points0, points1, *cameras)
        return bool(pose_errors(pose, self.posed)[ERROR] < GOOD_DEG)


class Photographs:
    """The photographs of a data folder from which synthetic pairs are made."""

    def __init__(self, data: Path) -> None:
        self.planes = sorted(data.glob("oxford/*/img1.*"))
        self.scenes = sorted(data.glob("middlebury/*/left.png"))
        self.others = sorted(data.glob("foreground/*.jpg"))

    def any(self, rng: np.random.Generator, size: tuple[int, int] = SIZE) -> np.ndarray:
        """Return a random one of the other photographs, scaled to this size."""
        return resized(load_image(self.others[rng.integers(len(self.others))]), size)

    def unlike(self, rng: np.random.Generator) -> list[np.ndarray]:
        """Return two different ones of the other photographs."""
        two = rng.choice(len(self.others), 2, replace=False)
        return [resized(load_image(self.others[number]), SIZE) for number in two]


def resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return a copy of the given size."""
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def corners(width: float, height: float) -> np.ndarray:
    """Return the (4, 2) corners of a rectangle that begins at the origin."""
    return np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)


def photographs_of(data: Path) -> Iterator[MadePair]:
    """Yield the pairs of photographs with known ground truth."""
    for scene in load_oxford(data / "oxford", "refined"):
        for planar in scene.pairs:
            images = load_image(planar.first), load_image(planar.second)
            mask = np.ones(images[0].shape[:2], bool)
            yield MadePair("oxford", images, planar.homography, mask)
    for left in sorted(data.glob("middlebury/*/left.png")):
        images = load_image(left), load_image(left.with_name("right.png"))
        mask = np.zeros(images[0].shape[:2], bool)
        yield MadePair("middlebury", images, np.eye(3), mask, ROWS)
    for posed in load_posed_scenes(data):
        for pair in posed.pairs:
            images = load_image(pair.first.path), load_image(pair.second.path)
            mask = np.zeros(images[0].shape[:2], bool)
            yield MadePair(posed.name, images, np.eye(3), mask, pair.fundamental, pair)


def planes(photographs: Photographs) -> Iterator[MadePair]:
    """Yield pairs with a plane that is seen from two places."""
    for number in range(PAIRS):
        rng = np.random.default_rng([0, number])
        share, rectified = (0.1, 0.2, 0.4)[number % 3], number % 2 == 1
        texture = load_image(photographs.planes[rng.integers(len(photographs.planes))])
        if rectified:
            left = photographs.scenes[rng.integers(len(photographs.scenes))]
            views = [
                resized(load_image(left.with_name(f"{s}.png")), SIZE) for s in ("left", "right")
            ]
        else:
            views = photographs.unlike(rng)
        side = float(np.sqrt(share * SIZE[0] * SIZE[1]))
        size = np.array([1.15 * side, side / 1.15])
        texture = resized(texture, (round(size[0]), round(size[1])))
        outline, placed = corners(*size), []
        for view in views:
            moved = outline + rng.uniform(0, 1, 2) * (np.array(SIZE) - size)
            moved = (moved + rng.uniform(-0.07, 0.07, (4, 2)) * side).clip(0, np.array(SIZE) - 1)
            placed.append(cv2.getPerspectiveTransform(outline, moved.astype(np.float32)))
            mask = cv2.warpPerspective(np.ones(texture.shape[:2], np.uint8), placed[-1], SIZE) > 0
            view[mask] = cv2.warpPerspective(texture, placed[-1], SIZE)[mask]
        whole = np.ones(texture.shape[:2], np.uint8)
        mask = cv2.warpPerspective(whole, placed[0], SIZE) > 0
        rest = "a scene with depth" if rectified else "unrelated"
        homography = placed[1] @ np.linalg.inv(placed[0])
        kind = f"plane of {share:.0%}, the rest {rest}"
        fundamental = ROWS if rectified else None
        yield MadePair(kind, (views[0], views[1]), homography, mask, fundamental)


def unrelated(photographs: Photographs) -> Iterator[MadePair]:
    """Yield all pairs of different photographs of planes and scenes."""
    for first, second in combinations([*photographs.planes, *photographs.scenes], 2):
        images = load_image(first), load_image(second)
        nothing = np.zeros(images[0].shape[:2], bool)
        yield MadePair("different scenes", images, np.eye(3), nothing)


def facades(photographs: Photographs) -> Iterator[MadePair]:
    """Yield two views of a facade with one repeated window, the second one window to the right."""
    kinds = "facade alone", "facade between unrelated things", "facade with what occurs once"
    for number in range(PAIRS):
        rng = np.random.default_rng([1, number])
        kind = kinds[number % 3]
        columns, rows = int(rng.integers(5, 9)), int(rng.integers(3, 6))
        part = 1.0 if kind == kinds[0] else 0.75
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
        if kind == kinds[2]:
            row, column = rng.integers(rows), rng.integers(1, columns - 1)
            y, x = row * period[1] + top, column * period[0] + left
            once = photographs.any(rng, tuple(inner.tolist()))
            facade[y : y + inner[1], x : x + inner[0]] = once
        width, height = (columns * period[0], rows * period[1])
        around = photographs.any(rng, (SIZE[0] + int(period[0]), SIZE[1]))
        unlike = photographs.unlike(rng) if kind == kinds[1] else []
        views, placed = [], []
        for view in range(2):
            start = view * period[0]
            canvas = np.array(around[:, start : start + SIZE[0]])
            if kind == kinds[0]:
                canvas = facade[period[1] // 2 :, period[0] // 2 + start :][: SIZE[1], : SIZE[0]]
                missing = SIZE[1] - canvas.shape[0], SIZE[0] - canvas.shape[1]
                canvas = np.pad(canvas, [(0, missing[0]), (0, missing[1]), (0, 0)], "symmetric")
            elif kind == kinds[1]:
                canvas = unlike[view]
                left = min(50, SIZE[0] - width)
                canvas[60 : 60 + height, left : left + width] = facade[:height, start:][:, :width]
            else:
                around_ = np.array(around)
                around_[60 : 60 + height, 90 : 90 + width] = facade[:height, :width]
                canvas = around_[:, start : start + SIZE[0]]
            outline = corners(*SIZE)
            moved = outline + rng.uniform(-0.05, 0.05, (4, 2)) * SIZE[1]
            seen = cv2.getPerspectiveTransform(outline, moved.astype(np.float32))
            warped = cv2.warpPerspective(canvas, seen, SIZE).astype(np.float32)
            warped = warped * rng.uniform(0.85, 1.15) + rng.normal(0, NOISE, warped.shape)
            views.append(np.clip(warped, 0, 255).astype(np.uint8))
            shift = np.eye(3)
            shift[0, 2] = -start
            placed.append(seen @ shift)
        homography = placed[1] @ np.linalg.inv(placed[0])
        yield MadePair(kind, (views[0], views[1]), homography, np.ones(SIZE[::-1], bool))


def hard_views(photographs: Photographs) -> Iterator[MadePair]:
    """Yield photographs with a view from the side, from further away, or in other tones."""
    for number in range(HARD_PAIRS):
        rng = np.random.default_rng([2, number])
        kind = ("seen from the side", "seen from the side", "zoomed", "other tones")[number % 4]
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
        outline = corners(*SIZE)
        moved = outline + rng.uniform(-0.03, 0.03, (4, 2)) * SIZE[1]
        homography = cv2.getPerspectiveTransform(outline, moved.astype(np.float32))
        homography = homography @ back @ change @ to_centre
        seen = cv2.warpPerspective(image1, homography, SIZE).astype(np.float32)
        seen = np.clip(seen + rng.normal(0, NOISE, seen.shape), 0, 255).astype(np.uint8)
        yield MadePair(kind, (image, seen), homography, np.ones(SIZE[::-1], bool))


def main() -> None:
    """Match all pairs and print a table with a row for each kind."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--only", choices=("photographs", "planes", "refusal", "hard"))
    parser.add_argument("--every", type=int, default=1, help="only every Nth pair")
    arguments = parser.parse_args()
    photographs, detector = Photographs(arguments.data), DeepDetect()
    pairs = {
        "photographs": (photographs_of(arguments.data),),
        "planes": (planes(photographs),),
        "refusal": (unrelated(photographs), facades(photographs)),
        "hard": (hard_views(photographs),),
    }
    rows: dict[str, list[list[bool]]] = {}
    for name, makers in pairs.items():
        for maker in makers if arguments.only in (None, name) else ():
            for pair in islice(maker, 0, None, arguments.every):
                matches = match_images(*pair.images, detector)
                wrong = len(matches) > 0 and not pair.is_right(matches.points0, matches.points1)
                high, fair = (matches.geometry.confidence == word for word in ("high", "fair"))
                counts = [high, high and wrong, fair, fair and wrong]
                rows.setdefault(pair.kind, []).append(counts)
    print("| kind | pairs | high | of these wrong | fair | of these wrong |")
    print("|---|---:|---:|---:|---:|---:|")
    for kind, values in rows.items():
        print(f"| {kind} | {len(values)} | {' | '.join(map(str, np.sum(values, axis=0)))} |")


if __name__ == "__main__":
    main()
