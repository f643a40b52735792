"""Readings: outputs of published networks (teachers) at keypoints, one file per photograph."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from deepdetect._shared.errors import OptionError
from deepdetect._shared.opencv import cv2
from deepdetect._shared.progress import progress
from deepdetect._shared.records import save_arrays
from deepdetect._shared.runtimes import start_session
from deepdetect.detector.points.detection import SIZE_PER_SIGMA, least_distances, rank_candidates
from deepdetect.detector.points.hessian_scales import build_scale_space
from deepdetect.features.selection import suppress_neighbors
from deepdetect.io.image import load_image, luma

from .aliked import load_aliked

POINTS, STRONG_SHARE, STRONG_DENSITY = 1280, 0.5, 2048 / (640 * 480)
"""A reading has at most 1,280 points, because each takes 400 bytes. Half of them are drawn from the
best-ranked points, which are as dense as 2,048 points in 640x480 pixels. The other half is drawn
from all weaker points, which are also described if 8,192 keypoints are requested."""

EDGEPOINT_MULTIPLE = 32
"""EdgePoint2 takes images whose sides are multiples of 32, since it reduces them by this factor."""


class Reading(NamedTuple):
    """The outputs of the teachers at keypoints of a photograph.

    Attributes:
        luma: the photograph, (H, W) uint8.
        xy: positions (N, 2) float32, in pixels.
        sizes: diameters (N,) float32, in pixels.
        codes: (N, 192) float16 descriptors: 64 numbers of EdgePoint2 and 128 of ALIKED, each part a
            unit vector.
        scores: (N,) float16 scores of ALIKED in [0, 1], the highest within 2 px.
    """

    luma: np.ndarray
    xy: np.ndarray
    sizes: np.ndarray
    codes: np.ndarray
    scores: np.ndarray


CODE_LENGTHS = (64, 128)
"""Lengths of the descriptors of EdgePoint2-E64 and ALIKED-n16rot, as in the published weights."""

EDGEPOINT_WEIGHT, WHITENING = 0.6, 0.75
"""EdgePoint2's part of a whitened code has 0.6 times the length of ALIKED's part. Values along an
axis are divided by their standard deviation to the power 0.75. With both descriptors joined, pairs
of webcam images with 2,048 points each have 913 correct matches (905 with the power 0.5, and 885
without whitening, lab/HISTORY.md)."""

SOME_READINGS, SOME_POINTS = 256, 80
"""Means and axes of the whitening are computed from about 80 points of each of 256 readings: 20,480
codes, a hundred for each of the 192 values, so that the choice of photographs hardly matters."""

SMALLEST_SHARE = 1e-3
"""This share of the largest variance is added to the variance along each axis, so that noise along
an axis is amplified at most 13 times as much as values along the axis of largest variance."""


class Whitening:
    """A map from codes of both teachers to joint unit vectors (..., 192) with more even variances.

    Published codes of different points are similar, since their mean is not zero: two codes of
    EdgePoint2 have a mean cosine of 0.55. With mean 0 and more even variances, more points match.

    Raises:
        OptionError: no reading is given.
    """

    def __init__(self, readings: Sequence[Path]) -> None:
        if not readings:
            raise OptionError("no photograph has a reading: read the teachers first")
        chosen = readings[:: max(1, len(readings) // SOME_READINGS)]
        codes = [load_reading(path).codes[:: POINTS // SOME_POINTS] for path in chosen]
        values = torch.from_numpy(np.concatenate(codes).astype(np.float32))
        self.means = values.mean(0)
        self.matrices: list[Tensor] = []
        for part in (values - self.means).split(CODE_LENGTHS, -1):
            variances, axes = torch.linalg.eigh(part.T @ part / len(part))
            variances = variances + SMALLEST_SHARE * variances.max()
            self.matrices.append(axes * variances ** (-WHITENING / 2) @ axes.T)

    def __call__(self, codes: Tensor) -> Tensor:
        """Whiten codes (..., 192)."""
        centred = (codes.float() - self.means.to(codes.device)).split(CODE_LENGTHS, -1)
        first, second = (
            normalize(part @ matrix.to(codes.device), dim=-1)
            for part, matrix in zip(centred, self.matrices, strict=True)
        )
        return normalize(torch.cat([EDGEPOINT_WEIGHT * first, second], -1), dim=-1)


class Teachers:
    """EdgePoint2-E64 and ALIKED-n16rot.

    `edgepoint` is an ONNX file that maps `image` (1, 1, H, W), the mean of red, green and blue in
    [0, 1], to `descriptors` (1, 64, H/4, W/4). `aliked` is the authors' file of weights.
    """

    def __init__(self, edgepoint: Path, aliked: Path) -> None:
        self.edgepoint, self.aliked = start_session(str(edgepoint), 1), load_aliked(aliked)

    def read(self, rgb: np.ndarray, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return codes (N, 192) and scores (N,), float32, at points of (H, W, 3) uint8 RGB."""
        image = torch.from_numpy(np.ascontiguousarray(rgb.transpose(2, 0, 1)[None])).float() / 255
        codes, scores = self.aliked(image, torch.from_numpy(xy).float())
        return np.hstack([self._read_edgepoint(rgb, xy), codes.numpy()]), scores.numpy()

    def _read_edgepoint(self, rgb: np.ndarray, xy: np.ndarray) -> np.ndarray:
        sides = np.array([rgb.shape[1], rgb.shape[0]])
        unit = EDGEPOINT_MULTIPLE
        width, height = (max(unit, round(side / unit) * unit) for side in sides.tolist())
        gray = rgb.astype(np.float32).mean(2) / 255
        if (width, height) != tuple(sides):
            how = cv2.INTER_AREA if width < sides[0] else cv2.INTER_LINEAR
            gray = cv2.resize(gray, (width, height), interpolation=how)
        (maps,) = self.edgepoint.run(["descriptors"], {"image": gray[None, None]})
        places = torch.from_numpy(((xy + 0.5) / sides * 2 - 1).astype(np.float32))[None, None]
        how = {"align_corners": False, "padding_mode": "border"}
        codes: Tensor = grid_sample(torch.from_numpy(maps), places, **how)[0, :, 0].T
        return normalize(codes, dim=1).numpy()


def choose_points(gray: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw strong and weak keypoints; return positions (N, 2) and diameters (N,), best first."""
    candidates, logits = rank_candidates(build_scale_space(gray))
    kept = suppress_neighbors(candidates.xy, logits, least_distances(candidates.sigma_px))
    best = min(len(kept), round(STRONG_DENSITY * gray.size))
    strong = rng.permutation(best)[: round(POINTS * STRONG_SHARE)]
    weak = best + rng.permutation(len(kept) - best)[: POINTS - len(strong)]
    rows = kept[np.sort(np.concatenate([strong, weak]))]
    return candidates.xy[rows], SIZE_PER_SIGMA * candidates.sigma_px[rows]


def read_photograph(teachers: Teachers, image: object) -> Reading:
    """Run the teachers at keypoints of a photograph in any form that `load_image` accepts."""
    rgb = load_image(image)
    gray = luma(rgb)
    xy, sizes = choose_points(gray, np.random.default_rng(0))
    codes, scores = teachers.read(rgb, xy)
    xy, sizes = xy.astype(np.float32), sizes.astype(np.float32)
    return Reading(gray, xy, sizes, codes.astype(np.float16), scores.astype(np.float16))


def reading_file(image: Path, folder: Path) -> Path:
    """Return the file of the reading of a photograph."""
    return folder / f"{image.stem}.npz"


def write_readings(
    images: Sequence[Path], folder: Path, teachers: Teachers, quiet: bool = True
) -> Iterator[int]:
    """Write the missing readings of photographs; yield the number of points of each.

    Files are written atomically, so an interrupted call can be repeated.
    """
    left = [image for image in images if not reading_file(image, folder).exists()]
    with progress(len(left), "reading", "photograph", quiet) as bar:
        for image in left:
            reading = read_photograph(teachers, image)
            save_arrays(reading_file(image, folder), reading._asdict(), compress=False)
            bar.update(1)
            yield len(reading.xy)


def load_reading(path: Path) -> Reading:
    """Load a file that `write_readings` wrote."""
    with np.load(path) as stored:
        values: dict[str, Any] = {name: stored[name] for name in Reading._fields}
    return Reading(**values)
