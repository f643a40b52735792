"""From an image to a heat map: for each pixel, the probability of a keypoint."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from .._shared.errors import OptionError, unknown_name
from .._shared.image_array import Channels, check_channels
from .._shared.opencv import cv2
from .._shared.options import check_ranges, suggest_keywords
from .._shared.parallel import available_memory, release_freed_memory
from ..features.maps import Maps, Rows, bands, sigmoid
from .backends import Network

if TYPE_CHECKING:
    from .tiling import TiledNetwork

STRIDE = 8
"""The network halves an image three times, so its sides must be multiples of 8."""

MAX_AUTO_PIXELS = 2_000_000
"""Of an image that the resolution "auto" takes as it is."""

RELEASE_PIXELS = 20_000_000
"""Of an image whose maps need the memory that the network keeps: less would not be worth it."""

MIN_TILE_MEGAPIXELS = 1.5
"""Of smaller tiles most would be overlap."""


@suggest_keywords
@dataclass(frozen=True)
class HeatmapOptions:
    """How an image is shown to the network.

    Attributes:
        resolution: "native" takes the image as it is. "auto" does so up to two megapixels, and
            scales larger images down to that and the map back: their finest pixels show blur and
            noise more than structure, and the network needs seconds and gigabytes for them. A
            number of pixels squashes the image to a square of that side and the map back, as the
            paper does with 480.
        network_channels: order of the colours that the network sees. "bgr" is what the paper's
            published code feeds, though the weights were trained on RGB. It says nothing of the
            images that are given: that is `channels` of each function that takes one.
        tta: test-time augmentation. "flip" takes the mean of the logits of the image in its eight
            flips and quarter turns: eight times the time, and a flipped or turned image gives the
            same keypoints. Without it .92 to .94 of them are the same.
        tile_megapixels: with `resolution="native"`, images above so many megapixels are run in
            tiles of this size, with the logits of the whole image to 1e-4, in four to six times the
            time and less memory.
            At least 1.5; "auto": tiles of 2.7 where the image is too large for the
            free memory. Only weights of this package's training in ONNX files can be tiled.

    Raises:
        OptionError: a value is unknown or out of its range.
    """

    resolution: Literal["auto", "native"] | int = "auto"
    network_channels: Channels = "rgb"
    tta: Literal["none", "flip"] = "none"
    tile_megapixels: float | Literal["auto"] = "auto"

    def __post_init__(self) -> None:
        if isinstance(self.resolution, str):
            if self.resolution not in ("auto", "native"):
                known = ["auto", "native", "a number of pixels"]
                raise unknown_name("resolution", self.resolution, known)
        elif (
            not isinstance(self.resolution, (int, np.integer))
            or self.resolution < 16
            or self.resolution % STRIDE
        ):
            raise OptionError(
                f"the resolution must be 'auto', 'native' or a multiple of {STRIDE} from 16 on, "
                f"not {self.resolution}"
            )
        check_channels(self.network_channels)
        if self.tta not in ("none", "flip"):
            raise unknown_name("tta", self.tta, ["none", "flip"])
        if self.tile_megapixels != "auto":
            check_ranges(self, between={"tile_megapixels": (MIN_TILE_MEGAPIXELS, math.inf)})


def compute_heatmap(
    rgb: np.ndarray, network: Network, options: HeatmapOptions = HeatmapOptions()
) -> np.ndarray:
    """Run the network on an image.

    Args:
        rgb: (H, W, 3) uint8 RGB.
        network: the loaded network.
        options: the resolution and the order of the channels.

    Returns:
        (H, W) float32 probability in [0, 1], at the image's own pixels. A constant
        image holds nothing to detect: its map is 0 throughout.
    """
    return compute_heatmap_and_logits(rgb, network, options)[0]


def compute_heatmap_and_logits(
    rgb: np.ndarray, network: Network, options: HeatmapOptions = HeatmapOptions()
) -> tuple[np.ndarray, np.ndarray]:
    """Run the network on an image; arguments as of `compute_heatmap`.

    Returns:
        The heat map, and the (H, W) float32 logits of its probabilities. Float32 rounds the
        highest probabilities to 1; logits still distinguish them, so keypoints are ranked by them.
    """
    maps = compute_maps(rgb, network, options)
    heatmap, rows_of = np.empty(maps.shape, np.float32), maps.heatmap()
    for rows in bands(maps.shape):
        heatmap[rows] = rows_of(rows)
    del rows_of  # it may hold another map
    return heatmap, maps.logits()


def compute_maps(
    rgb: np.ndarray, network: Network, options: HeatmapOptions = HeatmapOptions()
) -> Maps:
    """Run the network on an image; arguments as of `compute_heatmap`.

    Returns:
        The heat map and its logits. Where the network sees a smaller image, only what it
        says of that is kept, and enlarged when a map is asked for.
    """
    height, width = rgb.shape[:2]
    if _is_native(rgb, options):
        return Maps.of_logits(_native_logits(rgb, network, options))
    if options.tile_megapixels != "auto":
        raise OptionError("`tile_megapixels` needs `resolution='native'`: scaled images are small")
    if _is_constant(rgb):
        return Maps.of_logits(np.full((height, width), -np.inf, np.float32))
    shown = rgb if options.network_channels == "rgb" else rgb[:, :, ::-1]
    shown = np.ascontiguousarray(shown)
    if options.resolution == "auto":
        scale = (MAX_AUTO_PIXELS / (height * width)) ** 0.5
        size = [max(STRIDE, round(side * scale / STRIDE) * STRIDE) for side in (width, height)]
        small = cv2.resize(shown, size, interpolation=cv2.INTER_AREA)
    else:
        side = int(options.resolution)
        small = cv2.resize(shown, (side, side), interpolation=cv2.INTER_CUBIC)
    logits = _mean_of_flips(partial(_run, network), small, options)
    if height * width > RELEASE_PIXELS and hasattr(network, "release_memory"):
        network.release_memory()
        release_freed_memory()

    def enlarged(map_: np.ndarray) -> np.ndarray:
        return cv2.resize(map_, (width, height), interpolation=cv2.INTER_CUBIC)

    def heatmap() -> Rows:
        map_ = enlarged(sigmoid(logits))
        return lambda rows: np.clip(map_[rows], 0, 1)

    return Maps((height, width), heatmap, lambda: enlarged(logits))


def _is_native(rgb: np.ndarray, options: HeatmapOptions) -> bool:
    """Return whether the network sees an image at its own size."""
    whole = rgb.shape[0] * rgb.shape[1] <= MAX_AUTO_PIXELS
    return options.resolution == "native" or (options.resolution == "auto" and whole)


def _native_logits(rgb: np.ndarray, network: Network, options: HeatmapOptions) -> np.ndarray:
    """Run the network on an image at its own size, in tiles where it is too large for the memory.

    Args:
        rgb: (H, W, 3) uint8 RGB.
        network: the loaded network.
        options: the order of the channels, tiles and flips.

    Returns:
        (H, W) float32 logits.
    """
    if _is_constant(rgb):
        return np.full(rgb.shape[:2], -np.inf, np.float32)
    shown = rgb if options.network_channels == "rgb" else rgb[:, :, ::-1]
    tiled = _tiled(network, shown.shape[0] * shown.shape[1], options)
    if tiled is None:
        return np.ascontiguousarray(_mean_of_flips(partial(_run, network), shown, options))
    area = None if options.tile_megapixels == "auto" else float(options.tile_megapixels)
    return _mean_of_flips(lambda turned: tiled(turned, area), shown, options)


def _tiled(network: Network, pixels: int, options: HeatmapOptions) -> TiledNetwork | None:
    """Return the network for tiles, or None for an image that is run whole."""
    path = getattr(network, "onnx_path", None)  # torch, bfloat16 and others run whole
    if options.tile_megapixels == "auto":
        if path is None or pixels * network.bytes_per_pixel <= available_memory():  # type: ignore[attr-defined]
            return None
        return _open_tiled(path, network)
    if pixels <= options.tile_megapixels * 1e6:
        return None
    tiled = None if path is None else _open_tiled(path, network)
    if tiled is None:
        raise OptionError(
            "this network cannot be run in tiles: leave `tile_megapixels` out, or use ONNX weights "
            "that deepdetect has trained, in float32"
        )
    return tiled


def _open_tiled(path: Path, network: Network) -> TiledNetwork | None:
    from .tiling import open_tiled

    return open_tiled(path, network.threads)  # type: ignore[attr-defined]


def _is_constant(rgb: np.ndarray) -> bool:
    return all((rgb[rows] == rgb[0, 0]).all() for rows in bands(rgb.shape))


def _pad(rgb: np.ndarray) -> np.ndarray:
    """Repeat the last row and column until both sides are multiples of 8."""
    below, right = -rgb.shape[0] % STRIDE, -rgb.shape[1] % STRIDE
    if not below and not right:
        return rgb
    return np.pad(rgb, ((0, below), (0, right), (0, 0)), mode="edge")


def _run(network: Network, rgb: np.ndarray) -> np.ndarray:
    """Return the (H, W) logits of an image, each flip of which is padded by itself."""
    padded = _pad(rgb)
    planes = np.empty((1, 3, *padded.shape[:2]), np.float32)
    np.multiply(padded.transpose(2, 0, 1), np.float32(1 / 255), out=planes[0])
    return network(planes)[0, 0, : rgb.shape[0], : rgb.shape[1]]


def _mean_of_flips(
    run: Callable[[np.ndarray], np.ndarray], rgb: np.ndarray, options: HeatmapOptions
) -> np.ndarray:
    """Return the logits of an image, with `tta` the mean of those of its flips and turns."""
    if options.tta == "none":
        return run(rgb)
    total = np.zeros(rgb.shape[:2], np.float32)
    for turns in range(4):
        turned = np.rot90(rgb, turns)
        for step in (1, -1):
            total += np.rot90(run(turned[:, ::step])[:, ::step], -turns)
    total /= 8
    return total
