"""Draw pairs of views of one photograph with the keypoints that both show, as training sees them.

Both views are warped (zoom, rotation, tilt, perspective), the second also by a smooth relief; parts
of other photographs may lie in front, each of which moves a little on its own; and each view has
its own light, blur, noise and JPEG. So depth, occlusion and darkness are seen without any pair of
real photographs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from deepdetect._shared.opencv import cv2
from deepdetect.detector.points.detection import SIZE_PER_SIGMA
from deepdetect.detector.points.hessian_scales import build_scale_space, find_candidates
from deepdetect.geometry.transforms import transform_points
from deepdetect.io.image import load_image, luma

SIDE_PX, KEYPOINTS = 256, 256
"""Of the square views, unless they are drawn larger, and of a pair at most."""

LEAST_KEYPOINTS, LEAST_IF_ZOOMED = 64, 40
"""Pairs that share fewer are drawn again; zoomed are those by more than e^0.8."""

STRONGEST, MAX_FIRST_SIGMA_PX = 600, 5.1
"""Of the candidates in the first view, which those in the second are found by."""

SIGMA_RANGE_PX, MARGIN_PX = (1.0, 13.0), 6
"""Of keypoints in the second view."""

SCALE_RANGE = (0.42, 1.8)
"""Pixels of the photograph to one of a view."""

MIN_GROWTH = 0.02
"""Of areas from the first view to the second: what is seen from its side is not described."""

ITERATIONS = 5
"""That invert a relief, whose slopes are small."""


class Pair(NamedTuple):
    """Two views and their keypoints, row by row: arrays, or tensors with another axis for a batch.

    Attributes:
        images: (2, S, S) uint8.
        positions0, positions1: (N, 2) float32 pixels.
        sizes0, sizes1: (N,) float32 pixels.
        turns: (N,) float32 radians from the first view to the second.
        valid: (N,) bool; the other rows are padding.
        turn, zoom: of the whole view, absolute, in radians and as a logarithm.
    """

    images: Any
    positions0: Any
    positions1: Any
    sizes0: Any
    sizes1: Any
    turns: Any
    valid: Any
    turn: Any
    zoom: Any


@dataclass(frozen=True)
class View:
    """Where a view shows a photograph: a homography of its pixels moved by a relief (S, S, 2)."""

    matrix: np.ndarray
    relief: np.ndarray | None = None
    side_px: int = SIDE_PX

    def to_photograph(self, xy: np.ndarray) -> np.ndarray:
        """Map (N, 2) or (H, W, 2) positions of the view."""
        mapped = transform_points(xy + self._moved(xy), self.matrix)
        return mapped.astype(np.float32).reshape(xy.shape)

    def from_photograph(self, xy: np.ndarray) -> np.ndarray:
        """Map (N, 2) positions of the photograph, by iteration where there is a relief."""
        flat = result = transform_points(xy, np.linalg.inv(self.matrix)).astype(np.float32)
        for _ in range(ITERATIONS if self.relief is not None else 0):
            result = flat - self._moved(result)
        return result

    def render(self, image: np.ndarray, border: int = cv2.BORDER_REFLECT_101) -> np.ndarray:
        """Return what the view shows of an image, (S, S) float32."""
        at = self.to_photograph(_pixels(self.side_px))
        return cv2.remap(image, at, None, cv2.INTER_LINEAR, borderMode=border).astype(np.float32)

    def _moved(self, xy: np.ndarray) -> np.ndarray:
        if self.relief is None or not len(xy):
            return np.zeros_like(xy)
        at = xy.reshape(len(xy), -1, 2)
        moved = cv2.remap(self.relief, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return moved.reshape(xy.shape)


class Layer(NamedTuple):
    """A photograph, RGB, in both views; (H, W) float32 in [0, 1] where it covers what is behind."""

    photograph: np.ndarray
    views: tuple[View, View]
    shape: np.ndarray | None = None


def _draw_matrix(
    rng: np.random.Generator,
    side_px: int,
    middle: Any,
    scale: float,
    angle: float,
    tilt: float,
    bend: float = 1,
) -> np.ndarray:
    """Draw a homography from a view's pixels to those of a photograph, around a middle in it."""
    bend *= SIDE_PX / side_px
    azimuth, perspective = rng.uniform(0, math.pi), bend * rng.normal(0, 0.0009, 2)
    stretch = np.diag([math.sqrt(tilt), 1 / math.sqrt(tilt)])
    affine, shift, bent = np.eye(3), np.eye(3), np.eye(3)
    affine[:2, :2] = _rotation(angle) @ _rotation(azimuth) @ stretch @ _rotation(-azimuth) * scale
    affine[:2, 2] = middle
    shift[:2, 2] = -(side_px - 1) / 2
    bent[2, :2] = perspective
    return affine @ bent @ shift


def _rotation(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


CROSS_MODAL_SHARE, MIXED_SHARE = 0.6, 0.45
"""Of pairs for images of different sensors, those of which one view has other tones, and those of
which one is of another mixture of colours."""


def _smooth_noise(
    rng: np.random.Generator, side_px: int, cells: tuple[int, int] = (3, 8)
) -> np.ndarray:
    noise = rng.standard_normal((int(rng.integers(*cells)),) * 2).astype(np.float32)
    return cv2.resize(noise, (side_px, side_px), interpolation=cv2.INTER_CUBIC)


@lru_cache
def _pixels(side_px: int) -> np.ndarray:
    return np.stack(np.meshgrid(*[np.arange(side_px, dtype=np.float32)] * 2), -1)


def draw_layers(
    rng: np.random.Generator, files: Sequence[Path], side_px: int = SIDE_PX
) -> tuple[list[Layer], list[float], float]:
    """Draw what two views show, from the back: layers, the views' scales, the turn in radians."""
    normal, uniform, chance = rng.normal, rng.uniform, rng.random

    def draw_photograph() -> np.ndarray:
        return load_image(files[int(rng.integers(len(files)))])

    photograph = draw_photograph()
    middle = np.array(photograph.shape[1::-1]) / 2 + uniform(-90, 90, 2)
    scale = math.exp(uniform(math.log(0.6), math.log(1.5)))
    zoom = math.exp(uniform(-0.2, 0.2))
    if chance() < 0.5:
        zoom = math.exp(uniform(-math.log(2.1), math.log(2.1)))
    if chance() < 0.18:
        zoom = math.exp(uniform(math.log(1.8), math.log(4.2)) * rng.choice([-1, 1]))
    smallest, largest = SCALE_RANGE
    factor = min(1, largest / (scale * max(1, zoom)))
    factor = max(factor, smallest / (scale * min(1, zoom)))
    scales = [scale * factor, scale * factor * zoom]
    base = uniform(-math.pi, math.pi) if chance() < 0.3 else normal(0, 0.12)
    turn = uniform(-math.pi, math.pi) if chance() < 0.45 else normal(0, 0.15)
    tilt = math.exp(abs(normal(0, 0.35)) if chance() < 0.7 else uniform(0, math.log(2.5)))
    own = _draw_matrix(rng, side_px, middle, scales[0], base, 1 + 0.15 * chance(), 0.5)
    first = View(own, None, side_px)
    moved, relief = middle + normal(0, 18, 2) * scales[0], None
    if chance() < 0.45:
        azimuth, height = uniform(0, 2 * math.pi), _smooth_noise(rng, side_px) * uniform(1.5, 5)
        relief = np.stack([height * math.cos(azimuth), height * math.sin(azimuth)], -1)
        relief = relief.astype(np.float32)
    second = View(_draw_matrix(rng, side_px, moved, scales[1], base + turn, tilt), relief, side_px)
    layers = [Layer(photograph, (first, second))]
    for _ in range(int(rng.choice([1, 1, 2, 3])) if chance() < 0.5 else 0):
        other = draw_photograph() if chance() < 0.8 else photograph
        noise = _smooth_noise(rng, 480)
        shape = (noise > np.quantile(noise, uniform(0.6, 0.88))).astype(np.float32)
        place = middle + uniform(-60, 60, 2), scales[0] * math.exp(normal(0, 0.2))
        own = _draw_matrix(rng, side_px, *place, base + normal(0, 0.3), 1 + 0.3 * chance(), 0.5)
        # It moves as the photograph behind it does, and a little more.
        place = moved + normal(0, 22, 2) * scales[0], scales[1] * math.exp(normal(0, 0.12))
        tilted = base + turn + normal(0, 0.06), tilt * math.exp(normal(0, 0.15))
        motion = np.linalg.inv(first.matrix) @ _draw_matrix(rng, side_px, *place, *tilted)
        pair = View(own, None, side_px), View(own @ motion, None, side_px)
        layers.append(Layer(other, pair, shape))
    return layers, scales, abs(turn)


def render_layers(
    layers: Sequence[Layer], side: int, scale: float, mixture: np.ndarray | None = None
) -> tuple[np.ndarray, ...]:
    """Return one of the views, (S, S) float32, and the number of the layer in each pixel.

    In luma, or in a (1, 3) mixture of colours.
    """
    size = (layers[0].views[side].side_px,) * 2
    view, top = np.zeros(size, np.float32), np.zeros(size, np.uint8)
    for number, (photograph, views, shape) in enumerate(layers):
        smooth = luma(photograph) if mixture is None else mix_colours(photograph, mixture)
        if scale > 1.15:  # so that it is not aliased
            smooth = cv2.GaussianBlur(smooth, (0, 0), 0.5 * math.sqrt(scale * scale - 1))
        shown = views[side].render(smooth)
        if shape is None:
            view = shown
            continue
        shape = cv2.resize(shape, smooth.shape[::-1])
        cover = views[side].render(shape, cv2.BORDER_CONSTANT)
        view = view * (1 - cover) + shown * cover
        top[cover > 0.5] = number
    return view, top


def correspond(
    layers: Sequence[Layer], tops: Sequence[np.ndarray], xy: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where the second view shows (N, 2) float32 positions of the first one.

    By the layers, and their numbers in the pixels of both views: (N, 2) positions, (N, 2, 2)
    derivatives of these by those given, and (N,) whether they are seen.
    """
    there, jacobians = np.zeros_like(xy), np.zeros((len(xy), 2, 2))
    layer_of, visible = _at(tops[0], xy), np.zeros(len(xy), bool)
    for number, (photograph, (first, second), _) in enumerate(layers):
        rows = np.flatnonzero(layer_of == number)
        places = first.to_photograph(xy[rows])
        there[rows] = second.from_photograph(places)
        last = np.array(photograph.shape[1::-1]) - 1
        visible[rows] = ((places >= 0) & (places < last)).all(1)
        for axis, step in enumerate(2 * np.eye(2, dtype=np.float32)):
            ends = (first.to_photograph(xy[rows] + sign * step) for sign in (1, -1))
            after, before = map(second.from_photograph, ends)
            jacobians[rows, :, axis] = (after - before) / 4
    inside = ((there > MARGIN_PX) & (there < len(tops[1]) - 1 - MARGIN_PX)).all(1)
    return there, jacobians, visible & inside & (_at(tops[1], there) == layer_of)


def _at(numbers: np.ndarray, xy: np.ndarray) -> np.ndarray:
    column, row = np.clip(np.rint(xy), 0, len(numbers) - 1).astype(int).T
    return numbers[row, column]


def draw_pair(
    rng: np.random.Generator, files: Sequence[Path], cross_modal: bool = False
) -> Pair | None:
    """Draw a pair of views, as of one or of different sensors; None where they share too little."""
    layers, scales, turn = draw_layers(rng, files)
    mixtures: list[np.ndarray | None] = [None, None]
    if cross_modal and rng.random() < MIXED_SHARE:
        mixtures[int(rng.integers(2))] = draw_mixture(rng)
    rendered = (render_layers(layers, k, scales[k], mixtures[k]) for k in range(2))
    views, tops = zip(*rendered, strict=True)
    seen = [view / 255 for view in views]
    if cross_modal and rng.random() < CROSS_MODAL_SHARE:
        other = int(rng.integers(2))
        seen[other] = change_tones(rng, seen[other])
    images = [relight(rng, view) for view in seen]
    clean = rng.random() < 0.6
    xy0, sigmas0 = find_keypoints(views[0].astype(np.uint8) if clean else images[0])
    xy0 = (xy0 + rng.uniform(-0.5, 0.5, xy0.shape)).astype(np.float32)
    xy1, jacobians, valid = correspond(layers, tops, xy0)
    growth = np.linalg.det(jacobians)
    # Detectors measure sizes with errors, of which some are large, as they do positions.
    spread = np.where(rng.random(len(xy0)) < 0.6, 0.12, 0.4)
    sigmas1 = sigmas0 * np.sqrt(growth.clip(min=1e-4)) * np.exp(rng.normal(0, spread))
    least, most = SIGMA_RANGE_PX
    rows = np.flatnonzero(valid & (growth > MIN_GROWTH) & (sigmas1 > least) & (sigmas1 < most))
    zoom = abs(math.log(scales[1] / scales[0]))
    if len(rows) < (LEAST_IF_ZOOMED if zoom > 0.8 else LEAST_KEYPOINTS):
        return None
    rows = (rng.permutation(rows) if rng.random() < 0.7 else rows)[:KEYPOINTS]
    spread_px = 0.9 * (0.25 + 0.18 * np.minimum(sigmas1[rows], 6))
    xy1[rows] += rng.normal(0, 1, (len(rows), 2)) * spread_px[:, None]
    skew = jacobians[:, 1, 0] - jacobians[:, 0, 1]
    turns = np.arctan2(skew, jacobians[:, 0, 0] + jacobians[:, 1, 1])
    fields: list[Any] = [np.stack(images)]
    for values in (xy0, xy1, sigmas0 * SIZE_PER_SIGMA, sigmas1 * SIZE_PER_SIGMA, turns):
        fields.append(np.zeros((KEYPOINTS, *values.shape[1:]), np.float32))
        fields[-1][: len(rows)] = values[rows]
    fields += [np.arange(KEYPOINTS) < len(rows), np.float32(turn), np.float32(zoom)]
    return Pair(*fields)


def find_keypoints(view: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (N, 2) positions and (N,) sigmas of the strongest candidates for points."""
    found = find_candidates(build_scale_space(view))
    inside = (found.xy > MARGIN_PX) & (found.xy < len(view) - 1 - MARGIN_PX)
    rows = np.flatnonzero(inside.all(1) & (found.sigma_px < MAX_FIRST_SIGMA_PX))
    rows = rows[np.argsort(found.rank[rows])][:STRONGEST]
    return found.xy[rows], found.sigma_px[rows]


def draw_mixture(rng: np.random.Generator) -> np.ndarray:
    """Draw what a sensor sees of the colours, (1, 3) float32: a channel, or any mixture."""
    if rng.random() < 0.4:
        return np.eye(3, dtype=np.float32)[[int(rng.integers(3))]]
    weights = rng.normal(1 / 3, 0.6, (1, 3)).astype(np.float32)
    return weights / max(0.5, np.abs(weights).sum())


def mix_colours(photograph: np.ndarray, mixture: np.ndarray) -> np.ndarray:
    """Return (H, W) uint8 of (H, W, 3), lifted as far as colours that count less than 0 need."""
    mixed = cv2.transform(photograph.astype(np.float32), mixture)
    lifted: np.ndarray = np.clip(mixed - 255 * np.minimum(mixture, 0).sum(), 0, 255)
    return lifted.astype(np.uint8)


def change_tones(rng: np.random.Generator, view: np.ndarray) -> np.ndarray:
    """Return a (S, S) float32 view in [0, 1] as another sensor may see it.

    Inverted, by any curve of tones, by two that take turns over the view, or as its edges.
    """

    def curve() -> np.ndarray:
        tones = rng.random(int(rng.integers(3, 8)))
        tones = (tones - tones.min()) / (np.ptp(tones) + 1e-6)
        return np.interp(view, np.linspace(0, 1, len(tones)), tones).astype(np.float32)

    kind = rng.random()
    if kind < 0.35:
        return 1 - view
    if kind < 0.7:
        return curve()
    if kind < 0.88:
        field = _smooth_noise(rng, len(view), (2, 5))
        share = np.clip(0.5 + field / (2 * np.abs(field).max()), 0, 1)
        return curve() * share + curve() * (1 - share)
    smooth = cv2.GaussianBlur(view, (0, 0), rng.uniform(0.7, 1.5))
    edges = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    edges = np.clip(edges / (np.quantile(edges, 0.98) + 1e-3), 0, 1)
    return 1 - edges if rng.random() < 0.5 else edges


def relight(rng: np.random.Generator, view: np.ndarray) -> np.ndarray:
    """Change light, sharpness and noise of a (S, S) float32 view in [0, 1]; return uint8."""
    chance, uniform = rng.random, rng.uniform
    if chance() < 0.15:
        return np.clip(view * 255, 0, 255).astype(np.uint8)
    if chance() < 0.25:
        field, strength = _smooth_noise(rng, len(view), (2, 5)), 0.7 * chance() ** 0.5
        view = view * np.clip(1 + strength * field / np.abs(field).max(), 0.15, 1.6)
    if chance() < 0.15:  # a shadow with an edge
        direction = _rotation(uniform(0, 2 * math.pi))[0]
        side = (_pixels(len(view)) - len(view) / 2) @ direction > uniform(-80, 80)
        shadow = cv2.GaussianBlur(side.astype(np.float32), (0, 0), uniform(0.7, 8))
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
        light = math.exp(uniform(math.log(0.02), math.log(0.5)))
        view = view * light + noise * uniform(0.2, 0.6 + 2.4 * min(1, 4 * light))
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
