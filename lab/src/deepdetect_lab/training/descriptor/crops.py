"""Crops of photographs that teachers have read, changed as a camera would change them."""

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
"""Crops are three quarters as wide as the photographs, so that they show about as much around a
point as the teachers saw. Each step draws 384 of the points that were read there, because the loss
compares all with all."""

TURNED_SHARE, CLEAN_SHARE = 0.15, 0.4
"""Shares of the crops that are turned by any angle, and that show the photograph as it is. With
more turned or changed ones, the codes of upright photographs were learned less well."""

FAR_SCALE = Effect(0.4, math.log(0.4), math.log(2.4))
"""Share of the crops whose scale is not drawn from `SCALE` but from this wider range of its
logarithm, so that the network learns the same codes at any scale."""

ATTEMPTS = 50
"""Photographs are drawn this often until one has been read: training may start before all are."""


class Crops(NamedTuple):
    """A batch of crops, or one without the first axis.

    Attributes:
        images: (B, S, S) uint8 changed views, while the teachers read the unchanged photograph.
        positions: (B, N, 2) float32, in pixels.
        sizes: (B, N) float32 diameters, in pixels.
        codes: (B, N, 192) float16 codes of the teachers; in losses, float32 and whitened.
        survival: (B, N) float32, the share of the points of the photograph that ALIKED finds worse.
        turn: (B,) float32, the angle by which the photograph is turned, in radians.
    """

    images: Any
    positions: Any
    sizes: Any
    codes: Any
    survival: Any
    turn: Any


def draw_crop(rng: np.random.Generator, reading: Reading) -> Crops | None:
    """Draw a turned and zoomed crop of a photograph; return None if nothing was read there."""
    scale = math.exp((FAR_SCALE if FAR_SCALE.happens(rng) else SCALE).strength(rng))
    turned = happens(rng, TURNED_SHARE)
    angle = rng.uniform(-math.pi, math.pi) if turned else rng.normal(0, UPRIGHT_DEVIATIONS[0])
    size = np.array(reading.luma.shape[::-1])
    reach = np.maximum(0, size - scale * CROP_PX) / 2
    place = (size - 1) / 2 + rng.uniform(-reach, reach)
    # The view shows the photograph turned by `angle`: its own axes are turned back there.
    to_photograph = view_homography(CROP_PX, place, scale * rotation(-angle), np.zeros(2))
    xy = transform_points(reading.xy, np.linalg.inv(to_photograph))
    rows = np.flatnonzero(((xy > MARGIN_PX) & (xy < CROP_PX - 1 - MARGIN_PX)).all(1))
    if not len(rows):
        return None
    rows = rng.choice(rows, CROP_POINTS, replace=len(rows) < CROP_POINTS)
    view = View(to_photograph, side_px=CROP_PX).render(reading.luma) / WHITE
    places = xy[rows] + rng.uniform(-JITTER_PX, JITTER_PX, (CROP_POINTS, 2))
    sizes = reading.sizes[rows] / scale * np.exp(rng.normal(0, SIZE_ERRORS[0], CROP_POINTS))
    survival = reading.scores[:, 1].argsort(kind="stable").argsort()[rows] / len(reading.xy)
    places, sizes = places.astype(np.float32), sizes.astype(np.float32)
    clean = happens(rng, CLEAN_SHARE)
    image = (view * WHITE).clip(0, WHITE).astype(np.uint8) if clean else photograph_view(rng, view)
    survival = survival.astype(np.float32)
    return Crops(image, places, sizes, reading.codes[rows], survival, np.float32(angle))


def draw_crops(
    files: Sequence[Path], readings: Path, count: int, rng: np.random.Generator
) -> Crops:
    """Draw crops of photographs that have been read, and stack them.

    Raises:
        OptionError: hardly any photograph has been read.
    """
    drawn: list[Crops] = []
    for _ in range(ATTEMPTS * count):
        path = reading_file(files[int(rng.integers(len(files)))], readings)
        if path.exists() and (crop := draw_crop(rng, load_reading(path))) is not None:
            drawn.append(crop)
        if len(drawn) == count:
            return Crops(*(torch.from_numpy(np.stack(each)) for each in zip(*drawn, strict=True)))
    raise OptionError(f"hardly any photograph has been read in {readings}: read the teachers first")
