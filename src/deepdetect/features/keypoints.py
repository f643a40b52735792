"""The keypoints of one image: positions, scores, sizes, angles and descriptors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from .._shared.errors import OptionError, check_name, require_packages
from .._shared.image_array import Channels
from .._shared.machine import parallel_for
from .._shared.opencv import cv2
from .._shared.options import numbers_of, shown, suggest_keywords, whole

SIZES_PER_SCALE = {"diameter": 1.0, "sigma": 2.0}
"""Ratio of a keypoint's diameter to its "scale" in LightGlue, which is a diameter or a sigma."""

MAX_COORDINATE_BITS = 12
"""`bayer_order` uses at most this many bits of x and y, so that ranks are exact in float32."""

UNSET_ANGLE = -1
"""OpenCV gives this angle to keypoints without an orientation."""

_OPTIONAL: dict[str, Any] = {
    "logits": np.float32,
    "sizes": np.float32,
    "angles": np.float32,
    "octaves": np.int32,
}


@suggest_keywords
@dataclass(frozen=True, eq=False, repr=False)
class Keypoints:
    """Keypoints of one image.

    Attributes:
        xy: (N, 2) float32 positions in pixels, x to the right and y down; the centre of the first
            pixel is (0, 0).
        scores: (N,) float32, higher is better. Scores of a `PointDetector` lie in (0, 1) and all
            differ. Scores of `DeepDetect` are probabilities; float32 rounds the highest to 1, so
            `best` ranks by logits.
        image_size: (width, height) of the image in pixels.
        logits: (N,) float32 logits of the probabilities, or None.
        sizes: (N,) float32 diameters in pixels, or None if unknown.
        angles: (N,) float32 orientations in degrees (-1: unset), or None if unknown.
        octaves: (N,) int32 octaves and layers of SIFT, packed as in OpenCV, or None.
        descriptors: (N, D) uint8 or float32, or None if keypoints are not described.
        descriptor_type: type of the descriptors, such as "rootsift", or None if unknown.

    `len`, iteration over (x, y) rows and indexing by slices, masks and index arrays work.

    Raises:
        OptionError: the shapes do not fit together, or a number other than a logit is not finite.

    Example:
        >>> points = Keypoints([[1, 2], [3, 4]], [0.9, 0.6], (8, 8))
        >>> points
        Keypoints(2 keypoints in 8x8 pixels, scores 0.6 to 0.9)
        >>> points[points.scores > 0.8].xy.tolist()
        [[1.0, 2.0]]
    """

    xy: np.ndarray
    scores: np.ndarray
    image_size: tuple[int, int]
    logits: np.ndarray | None = None
    sizes: np.ndarray | None = None
    angles: np.ndarray | None = None
    octaves: np.ndarray | None = None
    descriptors: np.ndarray | None = None
    descriptor_type: str | None = None

    def __post_init__(self) -> None:
        xy = numbers_of("xy", self.xy, np.float32)
        xy = xy.reshape(0, 2) if xy.size == 0 else xy
        scores = numbers_of("scores", self.scores, np.float32)
        if xy.ndim != 2 or xy.shape[1] != 2 or scores.shape != xy.shape[:1]:
            raise OptionError(
                f"keypoints need (N, 2) positions and (N,) scores, "
                f"not {xy.shape} and {scores.shape}"
            )
        if not (np.isfinite(xy).all() and np.isfinite(scores).all()):
            raise OptionError("keypoints need finite positions and scores")
        fields = {"xy": xy, "scores": scores}
        whole = getattr(self.descriptors, "dtype", None) == np.uint8
        for name, dtype in {**_OPTIONAL, "descriptors": np.uint8 if whole else np.float32}.items():
            if getattr(self, name) is None:
                continue
            fields[name] = values = numbers_of(name, getattr(self, name), dtype)
            shape, axes = ("(N, D)", 2) if name == "descriptors" else ("(N,)", 1)
            if values.ndim != axes or len(values) != len(xy):
                raise OptionError(f"{len(xy)} keypoints need {shape} {name}, not {values.shape}")
            if name != "logits" and values.dtype.kind == "f" and not np.isfinite(values).all():
                raise OptionError(f"keypoints need finite {name}")
        for name, values in fields.items():
            object.__setattr__(self, name, values)
        size = numbers_of("image_size", self.image_size, np.float64)
        if size.shape != (2,) or not np.isfinite(size).all():
            raise OptionError(f"`image_size` must be (width, height), not {shown(self.image_size)}")
        object.__setattr__(self, "image_size", (int(size[0]), int(size[1])))

    @classmethod
    @suggest_keywords
    def empty(cls, image_size: tuple[int, int]) -> Keypoints:
        """Return an empty set of keypoints for an image of this size."""
        return cls(np.empty((0, 2), np.float32), np.empty(0, np.float32), image_size)

    @classmethod
    @suggest_keywords
    def from_opencv(
        cls, keypoints: Sequence[cv2.KeyPoint], image_size: tuple[int, int]
    ) -> Keypoints:
        """Convert OpenCV's keypoints; their responses become the scores.

        Args:
            keypoints: keypoints of a `cv2.Feature2D`.
            image_size: (width, height) of the image in pixels.

        Example:
            >>> Keypoints.from_opencv([cv2.KeyPoint(3, 4, 7, 90, 0.5)], (8, 8)).sizes.tolist()
            [7.0]
        """
        if not isinstance(keypoints, Sequence) or {*map(type, keypoints)} - {cv2.KeyPoint}:
            raise OptionError("`keypoints` must be a sequence of cv2.KeyPoint")
        if not len(keypoints):
            return cls.empty(image_size)
        return cls(
            cv2.KeyPoint_convert(keypoints),
            np.array([point.response for point in keypoints], np.float32),
            image_size,
            sizes=np.array([point.size for point in keypoints], np.float32),
            angles=np.array([point.angle for point in keypoints], np.float32),
            octaves=np.array([point.octave for point in keypoints], np.int32),
        )

    @suggest_keywords
    def to_opencv(self, size: float = 3.0, angle: float = -1.0) -> list[cv2.KeyPoint]:
        """Convert to OpenCV's keypoints, whose responses are the scores.

        Args:
            size: diameter in pixels if the keypoints have no sizes.
            angle: orientation in degrees if the keypoints have no angles (-1: unset).

        Example:
            >>> (point,) = Keypoints([[3, 4]], [0.5], (8, 8)).to_opencv(size=5)
            >>> point.pt, point.size, point.response
            ((3.0, 4.0), 5.0, 0.5)
        """
        count = len(self)
        columns = (
            *self.xy.T.tolist(),
            [size] * count if self.sizes is None else self.sizes.tolist(),
            [angle] * count if self.angles is None else self.angles.tolist(),
            self.scores.tolist(),
            [0] * count if self.octaves is None else self.octaves.tolist(),
        )
        return [cv2.KeyPoint(*row) for row in zip(*columns, strict=True)]

    @suggest_keywords
    def to_lightglue(
        self,
        *,
        scale: Literal["diameter", "sigma"] = "diameter",
        size: float = 3.0,
        angle: float = 0.0,
    ) -> dict[str, Any]:
        """Convert to the input of LightGlue for one image, as PyTorch tensors.

        `LightGlue(features="sift")` needs sizes, angles and RootSIFT descriptors, as
        `PointDetector(descriptor="rootsift")` computes them; up to 4,096 keypoints are usual.
        LightGlue has the same pixel coordinates: the centre of the first pixel is (0, 0).

        Args:
            scale: meaning of "scales": "diameter", as in LightGlue's own extractor for OpenCV, or
                "sigma", half the diameter, as in LightGlue's extractor for COLMAP and in kornia.
            size: diameter in pixels for keypoints without a size.
            angle: orientation in degrees for keypoints without an angle.

        Returns:
            float32 tensors with a batch dimension: "keypoints" (1, N, 2), "keypoint_scores" (1, N),
            "scales" (1, N) in pixels, "oris" (1, N) in radians, "image_size" (1, 2) as
            (width, height), and, if there are descriptors, "descriptors" (1, N, D), unit vectors.

        Raises:
            OptionError: the scale is unknown.
            MissingExtraError: torch is not installed.
        """
        check_name("scale", scale, SIZES_PER_SCALE)
        require_packages("LightGlue", "torch")
        import torch

        count = len(self)
        sizes = np.full(count, size, np.float32) if self.sizes is None else self.sizes
        angles = np.full(count, angle, np.float32) if self.angles is None else self.angles
        angles = np.where(angles == UNSET_ANGLE, np.float32(angle), angles)
        arrays = {
            "keypoints": self.xy,
            "keypoint_scores": self.scores,
            "scales": sizes / SIZES_PER_SCALE[scale],
            "oris": np.deg2rad(angles),
            "image_size": np.array(self.image_size),
        }
        if self.descriptors is not None:
            arrays["descriptors"] = unit_length(self.descriptors)
        return {name: torch.tensor(a, dtype=torch.float32)[None] for name, a in arrays.items()}

    @suggest_keywords
    def draw(self, image: Any, *, channels: Channels = "rgb") -> np.ndarray:
        """Draw the keypoints on their image, which is dimmed.

        Circles show the sizes of the keypoints; without sizes, all circles have a radius of three
        pixels. More than 5,000 keypoints are drawn as single pixels.

        Args:
            image: an array, a PyTorch tensor or a PIL image.
            channels: order of the colours in an array or a tensor.

        Returns:
            (H, W, 3) uint8 RGB.

        Raises:
            ImageError: the size of the image differs from `image_size`.
        """
        from ..viz.draw import draw_keypoints
        from .display import checked_image

        return draw_keypoints(checked_image(image, self.image_size, channels), self.xy, self.sizes)

    @property
    def density(self) -> float:
        """Keypoints per pixel."""
        width, height = self.image_size
        return len(self) / (width * height)

    @suggest_keywords
    def best(self, count: int) -> Keypoints:
        """Return the `count` best keypoints, in the order in which they are stored.

        Keypoints are ranked by logits or, without these, by scores. Ties are broken so that the
        chosen keypoints are spread evenly over the image.
        """
        if len(self) <= (count := whole("count", count)):
            return self
        ranks = self.scores if self.logits is None else self.logits
        order = bayer_order(self.xy, self.image_size)
        return self[np.sort(np.lexsort((order, -ranks))[:count])]

    def distinct(self) -> Keypoints:
        """Keep the best keypoint at each position: SIFT repeats a position for each orientation."""
        order = np.argsort(-self.scores, kind="stable")
        # x and y as one 64-bit number sort ten times as fast as rows do; + 0 turns -0 into 0.
        keys = np.ascontiguousarray(self.xy[order] + np.float32(0)).view(np.uint64).ravel()
        _, first = np.unique(keys, return_index=True)
        return self if len(first) == len(self) else self[np.sort(order[first])]

    def __len__(self) -> int:
        return len(self.xy)

    def __getitem__(self, index: slice | np.ndarray | list[int] | int) -> Keypoints:
        rows = [int(index)] if isinstance(index, (int, np.integer)) else index
        columns = {
            name: getattr(self, name) for name in ("xy", "scores", *_OPTIONAL, "descriptors")
        }
        return replace(self, **{k: v[rows] for k, v in columns.items() if v is not None})

    def __iter__(self) -> Iterator[np.ndarray]:
        return iter(self.xy)

    def _repr_html_(self) -> str:
        from .display import html_summary

        width, height = self.image_size
        rows = {"image": f"{width}x{height}", "density": f"{self.density:.3f} per pixel"}
        if len(self):
            rows["scores"] = f"{self.scores.min():.3g} to {self.scores.max():.3g}"
        if self.sizes is not None and len(self):
            rows["sizes"] = f"{self.sizes.min():.3g} to {self.sizes.max():.3g} px"
        names = (*_OPTIONAL, "descriptors")
        rows["also"] = ", ".join(n for n in names if getattr(self, n) is not None) or "nothing"
        return html_summary(f"{len(self):,} keypoints", rows, [(self.xy, self.image_size)])

    def __repr__(self) -> str:
        width, height = self.image_size
        text = f"{len(self)} keypoint{'s' * (len(self) != 1)} in {width}x{height} pixels"
        if len(self):
            text += f", scores {self.scores.min():.3g} to {self.scores.max():.3g}"
        if self.descriptors is not None:
            text += f", {self.descriptors.shape[1]}-D {self.descriptors.dtype} descriptors"
        return f"Keypoints({text})"


def unit_length(descriptors: np.ndarray) -> np.ndarray:
    """Return (N, D) descriptors as float32, scaled to length 1."""
    values = descriptors.astype(np.float32)
    lengths = np.linalg.norm(values, axis=1, keepdims=True)
    unit: np.ndarray = values / np.maximum(lengths, np.finfo(np.float32).tiny)
    return unit


def bayer_order(xy: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Rank (N, 2) positions so that those of the lowest ranks, however many, are spread evenly.

    The ranks, (N,) float32 in [0, 1), are values of a Bayer matrix (ordered dithering) that covers
    an image of this (width, height), at the pixels nearest to the positions.
    """
    column, row = np.rint(np.asarray(xy).reshape(-1, 2)).astype(np.int64).T
    bits = min(MAX_COORDINATE_BITS, max(1, (max(size) - 1).bit_length()))
    order = np.zeros(len(row), np.int64)
    for _ in range(bits):  # the lowest bits of the position become the highest bits of the rank
        order = 4 * order + 2 * ((column ^ row) & 1) + (row & 1)
        column, row = column >> 1, row >> 1
    return (order / 4**bits).astype(np.float32)


def nearest_keypoints(
    positions: np.ndarray, xy: np.ndarray, image_size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Find the keypoint nearest to each of (N, 2) positions, within the 3x3 pixels around it.

    If several keypoints lie on one pixel, only the first is used. Returns (N,) int32 rows of `xy`
    and (N,) distances in pixels; -1 and infinity without a keypoint in these pixels.
    """
    from .kernels import nearest_of_nine

    width, height = image_size
    pixels = np.floor(np.asarray(xy) + np.float32(0.5)).astype(np.int64).reshape(-1, 2)
    rows = np.flatnonzero(((pixels >= 0) & (pixels < image_size)).all(axis=1))[::-1]
    grid = np.full((height, width), -1, np.int32)
    grid[pixels[rows, 1], pixels[rows, 0]] = rows  # reversed: the first keypoint remains
    positions, xy = (np.ascontiguousarray(points, np.float64) for points in (positions, xy))
    nearest = np.full(len(positions), -1, np.int32)
    distances = np.full(len(positions), np.inf)
    parallel_for(len(positions), nearest_of_nine, positions, xy, grid, nearest, distances)
    return nearest, distances


def on_pixels(xy: np.ndarray, shape: tuple[int, ...] | None = None) -> bool:
    """Return whether all positions are whole numbers and, if `shape` is given, inside the image."""
    xy = np.asarray(xy)
    inside = (xy >= 0).all() and (shape is None or (xy < (shape[1], shape[0])).all())
    return bool(inside and (xy == np.rint(xy)).all())
