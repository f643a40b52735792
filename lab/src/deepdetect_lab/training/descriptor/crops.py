"""Crops of photographs with simulated camera effects, and the teachers' outputs (`Reading`)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from deepdetect._shared.errors import OptionError
from deepdetect.geometry.transforms import transform_points

from ..scenes import MARGIN_PX, SCALE, UPRIGHT_DEVIATIONS, View
from ..synthetic import WHITE, Effect, happens, rotation, view_homography
from ..teachers.readings import Reading, load_reading, reading_file
from .views import JITTER_PX, SIZE_ERRORS, photograph_view

CROP_PX, CROP_POINTS = 384, 384
"""Side of a crop in pixels, and number of points per crop. Crops are four fifths as wide as
photographs of 480 pixels, so that they show about as much around a point as the teachers saw. The
number of points is limited because the loss compares all pairs of points."""

TURNED_SHARE, CLEAN_SHARE = 0.15, 0.4
"""Share of the crops that are rotated by any angle, and share without camera effects. Chosen by
hand: with more rotated or degraded crops, training improved matches of upright images less."""

FAR_SCALE = Effect(0.4, math.log(0.4), math.log(2.4))
"""The log scale of 40 % of the crops is drawn from this range, which is wider than `SCALE`, so that
the network learns the same descriptors at any scale."""

ATTEMPTS = 50
"""Number of photographs to try per crop, because some have no stored outputs of
the teachers. Chosen by hand."""


class Crops(NamedTuple):
    """A batch of crops, or a single crop without the first axis.

    Attributes:
        images: (B, S, S) uint8 degraded views; the teachers saw the photograph itself.
        positions: (B, N, 2) float32, in pixels.
        sizes: (B, N) float32 diameters, in pixels.
        codes: (B, N, 192) float16 descriptors by the teachers; in losses, float32 and whitened.
        survival: (B, N) float32, share of the reading's points that have a lower ALIKED score.
        turn: (B,) float32, the angle by which the photograph is rotated, in radians.
    """

    images: Any
    positions: Any
    sizes: Any
    codes: Any
    survival: Any
    turn: Any


def draw_crop(rng: np.random.Generator, reading: Reading) -> Crops | None:
    """Draw a rotated and zoomed crop; return None if it holds no point of the reading."""
    scale = math.exp((FAR_SCALE if FAR_SCALE.happens(rng) else SCALE).strength(rng))
    turned = happens(rng, TURNED_SHARE)
    angle = rng.uniform(-math.pi, math.pi) if turned else rng.normal(0, UPRIGHT_DEVIATIONS[0])
    size = np.array(reading.luma.shape[::-1])
    reach = np.maximum(0, size - scale * CROP_PX) / 2
    place = (size - 1) / 2 + rng.uniform(-reach, reach)
    # The view shows the photograph rotated by `angle`, so the map back rotates by -`angle`.
    to_photograph = view_homography(CROP_PX, place, scale * rotation(-angle), np.zeros(2))
    xy = transform_points(reading.xy, np.linalg.inv(to_photograph))
    rows = np.flatnonzero(((xy > MARGIN_PX) & (xy < CROP_PX - 1 - MARGIN_PX)).all(1))
    if not len(rows):
        return None
    rows = rng.choice(rows, CROP_POINTS, replace=len(rows) < CROP_POINTS)
    view = View(to_photograph, side_px=CROP_PX).render(reading.luma) / WHITE
    places = xy[rows] + rng.uniform(-JITTER_PX, JITTER_PX, (CROP_POINTS, 2))
    sizes = reading.sizes[rows] / scale * np.exp(rng.normal(0, SIZE_ERRORS[0], CROP_POINTS))
    survival = reading.scores.argsort(kind="stable").argsort()[rows] / len(reading.xy)
    places, sizes = places.astype(np.float32), sizes.astype(np.float32)
    clean = happens(rng, CLEAN_SHARE)
    image = (view * WHITE).clip(0, WHITE).astype(np.uint8) if clean else photograph_view(rng, view)
    survival = survival.astype(np.float32)
    return Crops(image, places, sizes, reading.codes[rows], survival, np.float32(angle))


def draw_crops(
    files: Sequence[Path], readings: Path, count: int, rng: np.random.Generator
) -> Crops:
    """Draw crops of photographs that have a reading, and stack them.

    Raises:
        OptionError: hardly any photograph has a reading.
    """
    drawn: list[Crops] = []
    for _ in range(ATTEMPTS * count):
        path = reading_file(files[int(rng.integers(len(files)))], readings)
        if path.exists() and (crop := draw_crop(rng, load_reading(path))) is not None:
            drawn.append(crop)
        if len(drawn) == count:
            return Crops(*(torch.from_numpy(np.stack(each)) for each in zip(*drawn, strict=True)))
    raise OptionError(f"too few photographs have readings in {readings}: read the teachers first")
