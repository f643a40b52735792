"""Draw pairs of views of one photograph with the keypoints that both show, as training sees them.

Both views are warped (zoom, rotation, tilt, perspective), the second also by a smooth relief; parts
of another photograph may lie in front and move on their own; and each view has its own light, blur,
noise and JPEG. So depth, occlusion and darkness are seen without any pair of real photographs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

SIDE_PX = 256
KEYPOINTS = 256
SIGMAS_PX = (1.5, 2.02, 2.74, 3.7, 5.0)
SIZE_PER_SIGMA = 2.5
MARGIN_PX = 6
STRONGEST = 600
ENLARGEMENTS = (0.42, 1.8)
"""Pixels of the photograph to one of a view."""

PIXELS = np.stack(np.meshgrid(*[np.arange(SIDE_PX, dtype=np.float32)] * 2), -1)


class Pair(NamedTuple):
    """Two views, their keypoints row by row, and how these are turned; all rows are padded.

    images (2, S, S) uint8; positions0, positions1 (N, 2), sizes0, sizes1, turns (N,) float32 pixels
    and radians; valid (N,) bool; turn: of the whole view in radians.
    """

    images: np.ndarray
    positions0: np.ndarray
    positions1: np.ndarray
    sizes0: np.ndarray
    sizes1: np.ndarray
    turns: np.ndarray
    valid: np.ndarray
    turn: float


@dataclass
class View:
    """Where a view shows a photograph: a homography of its pixels moved by a relief."""

    matrix: np.ndarray
    relief: np.ndarray | None = None

    def moved(self, xy: np.ndarray) -> np.ndarray:
        """Return (N, 2) shifts of positions in the view."""
        if self.relief is None:
            return np.zeros_like(xy)
        at = (xy[:, axis].reshape(-1, 1).astype(np.float32) for axis in range(2))
        border = cv2.BORDER_REPLICATE
        shifts = cv2.remap(self.relief, *at, cv2.INTER_LINEAR, borderMode=border)
        return shifts.reshape(-1, 2)

    def to_photograph(self, xy: np.ndarray) -> np.ndarray:
        """Map (N, 2) positions of the view."""
        return project(self.matrix, xy + self.moved(xy))

    def from_photograph(self, xy: np.ndarray) -> np.ndarray:
        """Map (N, 2) positions of the photograph, by iteration where there is a relief."""
        flat = project(np.linalg.inv(self.matrix), xy)
        result = flat
        for _ in range(5 if self.relief is not None else 0):
            result = flat - self.moved(result)
        return result

    def render(self, image: np.ndarray, border: int = cv2.BORDER_REFLECT_101) -> np.ndarray:
        """Return what the view shows of an image, (S, S) float32."""
        shifted = PIXELS if self.relief is None else PIXELS + self.relief
        at = project(self.matrix, shifted.reshape(-1, 2)).reshape(SIDE_PX, SIDE_PX, 2)
        return cv2.remap(image, at, None, cv2.INTER_LINEAR, borderMode=border).astype(np.float32)


def project(matrix: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Map (N, 2) positions by a homography."""
    mapped = xy @ matrix[:, :2].T + matrix[:, 2]
    return (mapped[:, :2] / mapped[:, 2:]).astype(np.float32)


def view_matrix(
    center: np.ndarray,
    scale: float,
    angle: float,
    tilt: float,
    azimuth: float,
    perspective: np.ndarray,
) -> np.ndarray:
    """Return the homography from a view's pixels to those of the photograph, around a centre."""
    stretch = np.diag([math.sqrt(tilt), 1 / math.sqrt(tilt)])
    affine, shift, bend = np.eye(3), np.eye(3), np.eye(3)
    affine[:2, :2] = _rotation(angle) @ _rotation(azimuth) @ stretch @ _rotation(-azimuth) * scale
    affine[:2, 2] = center
    shift[:2, 2] = -(SIDE_PX - 1) / 2
    bend[2, :2] = perspective
    return affine @ bend @ shift


def _rotation(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def smooth_noise(rng: np.random.Generator, cells: int, side: int = SIDE_PX) -> np.ndarray:
    """Return (side, side) float32 noise that varies over so many cells."""
    noise = rng.standard_normal((cells, cells)).astype(np.float32)
    return cv2.resize(noise, (side, side), interpolation=cv2.INTER_CUBIC)


def smaller(photograph: np.ndarray, scale: float) -> np.ndarray:
    """Blur what a view shows reduced, so that it is not aliased."""
    if scale <= 1.15:
        return photograph
    return cv2.GaussianBlur(photograph, (0, 0), 0.5 * math.sqrt(scale * scale - 1))


def relight(rng: np.random.Generator, view: np.ndarray) -> np.ndarray:
    """Change light, sharpness and noise of a (S, S) float32 view in [0, 1]; return uint8."""
    chance, uniform = rng.random, rng.uniform
    if chance() < 0.15:
        return np.clip(view * 255, 0, 255).astype(np.uint8)
    if chance() < 0.25:
        field = smooth_noise(rng, int(rng.integers(2, 5)))
        strength = 0.7 * chance() ** 0.5
        view = view * np.clip(1 + strength * field / np.abs(field).max(), 0.15, 1.6)
    if chance() < 0.15:  # a shadow with an edge
        angle = uniform(0, 2 * math.pi)
        normal = np.array([math.cos(angle), math.sin(angle)], np.float32)
        side = ((PIXELS - SIDE_PX / 2) @ normal > uniform(-80, 80)).astype(np.float32)
        shadow = cv2.GaussianBlur(side, (0, 0), uniform(0.7, 8))
        view = view * (1 - shadow * uniform(0.2, 0.75))
    if chance() < 0.5:
        view = np.clip(view, 0, None) ** np.float32(math.exp(uniform(-0.8, 0.8)))
    if chance() < 0.12:  # any rising curve
        tones = np.concatenate([[0], np.sort(rng.random(6)), [1]])
        view = np.interp(view, np.linspace(0, 1, 8), tones).astype(np.float32)
    if chance() < 0.5:
        view = (view - 0.5) * uniform(0.35, 1.5) + 0.5 + uniform(-0.2, 0.2)
    if chance() < 0.35:
        view = cv2.GaussianBlur(view, (0, 0), 0.4 + 3 * chance() ** 1.5)
    elif chance() < 0.15:
        view = _motion_blur(rng, view)
    view = np.clip(view, 0, 1) * 255
    noise = rng.standard_normal(view.shape, dtype=np.float32)
    if chance() < 0.2:
        view = view * math.exp(uniform(math.log(0.06), math.log(0.5))) + noise * uniform(0.3, 3)
    elif chance() < 0.35:
        view = view + noise * uniform(1, 14)
    result: np.ndarray = np.clip(np.rint(view), 0, 255).astype(np.uint8)
    if chance() < 0.3:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(8, 75))]
        result = cv2.imdecode(cv2.imencode(".jpg", result, quality)[1], cv2.IMREAD_GRAYSCALE)
    return result


def _motion_blur(rng: np.random.Generator, view: np.ndarray) -> np.ndarray:
    length, angle = int(rng.integers(3, 12)), rng.uniform(0, math.pi)
    kernel, half = np.zeros((length, length), np.float32), (length - 1) / 2
    x, y = half * math.cos(angle), half * math.sin(angle)
    ends = [(round(half + sign * x), round(half + sign * y)) for sign in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], 1.0)
    return cv2.filter2D(view, -1, kernel / kernel.sum())


def find_keypoints(view: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (N, 2) positions and (N,) sigmas of the strongest maxima of |det Hessian|."""
    found = []
    for sigma in SIGMAS_PX:
        smooth = cv2.GaussianBlur(view.astype(np.float32), (0, 0), sigma)
        second = np.array([[1, -2, 1]], np.float32)
        mixed = np.array([[1, 0, -1], [0, 0, 0], [-1, 0, 1]], np.float32) / 4
        xx, yy, xy = (cv2.filter2D(smooth, -1, kernel) for kernel in (second, second.T, mixed))
        response = np.abs(xx * yy - xy * xy) * sigma**4
        peaks = response == cv2.dilate(response, np.ones((5, 5)))
        inside = np.zeros_like(peaks)
        inside[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX] = True
        y, x = np.nonzero(peaks & inside & (response > 0.01))
        found.append(np.stack([x, y, np.full(len(x), sigma), response[y, x]], 1))
    rows = np.concatenate(found)
    rows = rows[np.argsort(-rows[:, 3])][:STRONGEST]
    return rows[:, :2].astype(np.float32), rows[:, 2]


def _draw_views(
    rng: np.random.Generator, shape: tuple[int, ...]
) -> tuple[list[View], list[View], list[float], float]:
    """Return views of the photograph and of what is in front, their scales, and the turn."""
    normal, uniform, chance = rng.normal, rng.uniform, rng.random
    center = np.array([shape[1], shape[0]]) / 2 + uniform(-90, 90, 2)
    scale = math.exp(uniform(math.log(0.6), math.log(1.5)))
    zoom = math.exp(uniform(-0.2, 0.2))
    if chance() < 0.5:
        zoom = math.exp(uniform(-math.log(2.1), math.log(2.1)))
    if chance() < 0.14:
        zoom = math.exp(uniform(math.log(1.8), math.log(3.6)) * rng.choice([-1, 1]))
    smallest, largest = ENLARGEMENTS
    factor = min(1, largest / (scale * max(1, zoom)))
    factor = max(factor, smallest / (scale * min(1, zoom)))
    scales = [scale * factor, scale * factor * zoom]
    base = uniform(-math.pi, math.pi) if chance() < 0.3 else normal(0, 0.12)
    angle = uniform(-math.pi, math.pi) if chance() < 0.45 else normal(0, 0.15)
    tilt = math.exp(abs(normal(0, 0.35)) if chance() < 0.7 else uniform(0, math.log(2.5)))

    def perspective() -> np.ndarray:
        return normal(0, 0.0009, 2)

    first = view_matrix(
        center, scales[0], base, 1 + 0.15 * chance(), uniform(0, math.pi), perspective() / 2
    )
    center = center + normal(0, 18, 2) * scales[0]
    relief = None
    if chance() < 0.45:
        azimuth, amplitude = uniform(0, 2 * math.pi), uniform(1.5, 5)
        height = smooth_noise(rng, int(rng.integers(3, 8))) * amplitude
        relief = np.stack([height * math.cos(azimuth), height * math.sin(azimuth)], -1)
        relief = relief.astype(np.float32)
    placed = center, scales[1], base + angle, tilt, uniform(0, math.pi), perspective()
    second = View(view_matrix(*placed), relief)
    near = view_matrix(
        center + normal(0, 22, 2) * scales[0],
        scales[1] * math.exp(normal(0, 0.12)),
        base + angle + normal(0, 0.06),
        tilt,
        uniform(0, math.pi),
        perspective(),
    )
    return [View(first), second], [View(first), View(near)], scales, angle


def draw_pair(rng: np.random.Generator, photographs: np.ndarray) -> Pair | None:
    """Draw a pair of views of (N, H, W) photographs; None where they share too little."""
    photograph = photographs[int(rng.integers(len(photographs)))]
    views, near_views, scales, angle = _draw_views(rng, photograph.shape)
    layers = [(photograph, views)]
    masks = [np.zeros((SIDE_PX, SIDE_PX), bool)] * 2
    clean = [v.render(smaller(photograph, s)) for v, s in zip(views, scales, strict=True)]
    if rng.random() < 0.4:  # parts of another photograph in front
        other = photographs[int(rng.integers(len(photographs)))]
        layers.append((other, near_views))
        noise = smooth_noise(rng, int(rng.integers(3, 8)), len(other))
        shape = (noise > np.quantile(noise, rng.uniform(0.55, 0.85))).astype(np.float32)
        for k, (view, scale) in enumerate(zip(near_views, scales, strict=True)):
            cover = view.render(shape, cv2.BORDER_CONSTANT)
            clean[k] = clean[k] * (1 - cover) + view.render(smaller(other, scale)) * cover
            masks[k] = cover > 0.5
    images = [relight(rng, view / 255) for view in clean]
    xy0, sigmas = find_keypoints(clean[0] if rng.random() < 0.6 else images[0])
    xy0 = (xy0 + rng.uniform(-0.5, 0.5, xy0.shape)).astype(np.float32)
    xy1, jacobians = np.zeros_like(xy0), np.zeros((len(xy0), 2, 2))
    near, valid = _at(masks[0], xy0), np.zeros(len(xy0), bool)
    for layer, (image, (from_view, to_view)) in enumerate(layers):
        rows = np.flatnonzero(near == bool(layer))
        places = from_view.to_photograph(xy0[rows])
        xy1[rows] = to_view.from_photograph(places)
        height, width = image.shape
        valid[rows] = ((places >= 0) & (places < (width - 1, height - 1))).all(1)
        for axis, step in enumerate(np.array([[2, 0], [0, 2]], np.float32)):
            ends = [
                to_view.from_photograph(from_view.to_photograph(xy0[rows] + sign * step))
                for sign in (-1, 1)
            ]
            jacobians[rows, :, axis] = (ends[1] - ends[0]) / 4
    determinants = np.linalg.det(jacobians)
    growth = np.sqrt(np.clip(determinants, 1e-4, None)) * np.exp(rng.normal(0, 0.15, len(xy0)))
    sigmas1 = sigmas * growth
    valid &= ((xy1 > MARGIN_PX) & (xy1 < SIDE_PX - 1 - MARGIN_PX)).all(1) & (determinants > 0.02)
    valid &= (_at(masks[1], xy1) == near) & (sigmas1 > 1) & (sigmas1 < 13)
    rows = np.flatnonzero(valid)
    if len(rows) < (40 if abs(math.log(scales[1] / scales[0])) > 0.8 else 64):
        return None
    rows = (rng.permutation(rows) if rng.random() < 0.7 else rows)[:KEYPOINTS]
    # Detectors find a keypoint again only about there.
    spread = 0.9 * (0.25 + 0.18 * np.minimum(sigmas1[rows], 6))
    xy1[rows] += rng.normal(0, 1, (len(rows), 2)) * spread[:, None]
    skew = jacobians[:, 1, 0] - jacobians[:, 0, 1]
    turns = np.arctan2(skew, jacobians[:, 0, 0] + jacobians[:, 1, 1])
    columns = [xy0, xy1, sigmas * SIZE_PER_SIGMA, sigmas1 * SIZE_PER_SIGMA, turns]
    padded = [np.resize(each[rows], (KEYPOINTS, *each.shape[1:])) for each in columns]
    return Pair(
        np.stack(images),
        *(each.astype(np.float32) for each in padded),
        np.arange(KEYPOINTS) < len(rows),
        abs(angle),
    )


def _at(mask: np.ndarray, xy: np.ndarray) -> np.ndarray:
    column, row = np.clip(np.rint(xy).astype(int), 0, SIDE_PX - 1).T
    return mask[row, column]
