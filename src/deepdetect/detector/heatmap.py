"""From an image to a heat map: the probability of a keypoint for each pixel."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from .._shared.errors import DeepDetectError, OptionError, check_name
from .._shared.image_array import Channels, check_channels, fill_planes
from .._shared.machine import available_memory, release_freed_memory
from .._shared.opencv import cv2, is_lack_of_memory
from .._shared.options import check_ranges, suggest_keywords
from ..features.selection import Maps, Rows, bands, sigmoid
from .backends import Network
from .pretrained import STRIDE
from .tiling import BYTES_PER_PIXEL, open_tiled

MAX_AUTO_PIXELS = 2_000_000
"""The resolution "auto" scales larger images to this many pixels: finer detail is mostly noise."""

RELEASE_PIXELS = 20_000_000
"""If an image with more pixels than this was scaled down for the network, the memory that the
network keeps is released before the maps are enlarged. Chosen by hand."""

MIN_TILE_MEGAPIXELS = 1.5
"""Minimum size of a tile in megapixels, chosen by hand: smaller tiles overlap relatively more."""

Run = Callable[[np.ndarray], np.ndarray]
"""A function that maps an image, (H, W, 3) uint8, to its (H, W) logits."""


@suggest_keywords
@dataclass(frozen=True)
class HeatmapOptions:
    """How an image is prepared for the network. The fields are options of `DeepDetect`.

    Attributes:
        resolution: "native" (images keep their size), a multiple of 8 (images are resized to a
            square of this side in pixels), or "auto" (images over two megapixels are scaled down to
            that: finer pixels mostly show noise, and cost seconds and gigabytes).
        network_channels: order of the colours in the network's input: "rgb", or "bgr" as in the
            paper's published code, although the weights were trained on RGB. The order in the
            images that you give is another option, `channels`.
        tta: "none", or "flip": the mean logits of eight flips and quarter turns of the image.
        tile_megapixels: size of the tiles into which larger images are divided, 1.5 or more.
            "auto": 2.7, and only if memory is short. Only ONNX weights of the network `fast` can
            run in tiles: all bundled weights except "espnet".

    Raises:
        OptionError: a value is unknown or out of its range.
    """

    resolution: Literal["auto", "native"] | int = "auto"
    network_channels: Channels = "rgb"
    tta: Literal["none", "flip"] = "none"
    tile_megapixels: float | Literal["auto"] = "auto"

    def __post_init__(self) -> None:
        number = self.resolution if isinstance(self.resolution, (int, np.integer)) else 0
        if self.resolution not in ("auto", "native") and (number < 16 or number % STRIDE):
            raise OptionError(
                f"the resolution must be 'auto', 'native' or a multiple of {STRIDE} from 16 on, "
                f"not {self.resolution!r}"
            )
        check_channels(self.network_channels)
        check_name("tta", self.tta, ("none", "flip"))
        if self.tile_megapixels != "auto":
            check_ranges(self, between={"tile_megapixels": (MIN_TILE_MEGAPIXELS, math.inf)})
            if self.resolution != "native":
                raise OptionError("`tile_megapixels` needs `resolution='native'`: give both")


def is_native(shape: tuple[int, ...], options: HeatmapOptions) -> bool:
    """Return whether the network sees an image of shape (H, W, ...) at its own size."""
    small = shape[0] * shape[1] <= MAX_AUTO_PIXELS
    return options.resolution == "native" or (options.resolution == "auto" and small)


def seen_size(shape: tuple[int, ...], options: HeatmapOptions) -> tuple[int, int]:
    """Return the width and height at which the network sees an image of shape (H, W, ...)."""
    height, width = shape[:2]
    if is_native(shape, options):
        return width, height
    if options.resolution != "auto":
        return int(options.resolution), int(options.resolution)
    scale = (MAX_AUTO_PIXELS / (height * width)) ** 0.5
    width, height = (max(1, round(side * scale / STRIDE)) for side in (width, height))
    return STRIDE * width, STRIDE * height


def compute_maps(
    rgb: np.ndarray, network: Network, options: HeatmapOptions = HeatmapOptions()
) -> Maps:
    """Run the network on a (H, W, 3) uint8 RGB image.

    The maps have the size of the image: if the image was scaled for the network, the maps are
    scaled back on access. The heat map of a constant image is 0.
    """
    shape = rgb.shape[:2]
    if all((rgb[rows] == rgb[0, 0]).all() for rows in bands(rgb.shape)):
        return Maps.of_logits(np.full(shape, -np.inf, np.float32))
    tiled = _tiled(network, shape, options)
    logits = _mean_of_flips(tiled or partial(_run, network), _seen(rgb, options), options)
    large = shape[0] * shape[1] > RELEASE_PIXELS
    if large and not is_native(shape, options) and hasattr(network, "release_memory"):
        network.release_memory()
        release_freed_memory()
    return Maps.of_logits(logits) if logits.shape == shape else _enlarged(logits, shape)


@contextmanager
def memory_named(shape: tuple[int, ...], images: int = 1) -> Iterator[None]:
    """Convert out-of-memory errors in the block to an error that names the size of the image."""
    try:
        yield
    except Exception as error:
        if not (isinstance(error, MemoryError) or is_lack_of_memory(error)):
            raise
        raise DeepDetectError(
            f"there is not enough memory for {'an image' if images == 1 else f'{images} images'} "
            f"of {shape[1]}x{shape[0]} pixels: use `resolution='auto'`, fewer keypoints, or "
            f"{'a smaller image' if images == 1 else 'fewer images at once'}"
        ) from None


def _seen(rgb: np.ndarray, options: HeatmapOptions) -> np.ndarray:
    seen = rgb if options.network_channels == "rgb" else rgb[:, :, ::-1]
    if is_native(rgb.shape, options):
        return seen
    kind = cv2.INTER_AREA if options.resolution == "auto" else cv2.INTER_CUBIC
    size = seen_size(rgb.shape, options)
    return cv2.resize(np.ascontiguousarray(seen), size, interpolation=kind)


def _enlarged(logits: np.ndarray, shape: tuple[int, ...]) -> Maps:
    """Return the maps for an image of shape (H, W) from the logits of its scaled copy."""

    def enlarged(map_: np.ndarray) -> np.ndarray:
        return cv2.resize(map_, shape[::-1], interpolation=cv2.INTER_CUBIC)

    def heatmap() -> Rows:
        map_ = enlarged(sigmoid(logits))
        return lambda rows: np.clip(map_[rows], 0, 1)

    return Maps(shape, heatmap, lambda: enlarged(logits))


def _tiled(network: Network, shape: tuple[int, ...], options: HeatmapOptions) -> Run | None:
    """Return a function that runs the network in tiles, or None if the image is run as a whole."""
    path = getattr(network, "onnx_path", None)  # networks in torch or bfloat16 cannot be tiled
    area = None if options.tile_megapixels == "auto" else float(options.tile_megapixels)
    most = available_memory() / BYTES_PER_PIXEL if area is None else area * 1e6
    if not is_native(shape, options) or shape[0] * shape[1] <= most:
        return None
    tiled = None if path is None else open_tiled(path, network.threads)  # type: ignore[attr-defined]
    if tiled is not None:
        return lambda rgb: tiled(rgb, area)
    if area is None:
        return None
    raise OptionError(
        "this network cannot be run in tiles: leave `tile_megapixels` out, or use ONNX weights of "
        "the network `fast`, in float32"
    )


def _run(network: Network, rgb: np.ndarray) -> np.ndarray:
    height, width = rgb.shape[:2]
    planes = np.empty((1, 3, height + -height % STRIDE, width + -width % STRIDE), np.float32)
    fill_planes(rgb, planes[0])
    return np.ascontiguousarray(network(planes)[0, 0, :height, :width])


def _mean_of_flips(run: Run, rgb: np.ndarray, options: HeatmapOptions) -> np.ndarray:
    if options.tta == "none":
        return run(rgb)
    mean = np.zeros(rgb.shape[:2], np.float32)
    for turns in range(4):
        turned = np.rot90(rgb, turns)
        for step in (1, -1):
            mean += np.rot90(run(turned[:, ::step])[:, ::step], -turns)
    return mean / np.float32(8)
