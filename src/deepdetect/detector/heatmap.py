"""From an image to a heat map: for each pixel, the probability of a keypoint."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from .._shared.errors import DeepDetectError, OptionError, unknown_name
from .._shared.image_array import Channels, check_channels
from .._shared.memory import available_memory, release_freed_memory
from .._shared.opencv import cv2, is_lack_of_memory
from .._shared.options import check_ranges, suggest_keywords
from ..features.selection import Maps, Rows, bands, sigmoid
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


def compute_maps(
    rgb: np.ndarray, network: Network, options: HeatmapOptions = HeatmapOptions()
) -> Maps:
    """Run the network on an image.

    Args:
        rgb: (H, W, 3) uint8 RGB.
        network: the loaded network.
        options: the resolution and the order of the channels.

    Returns:
        The heat map and its logits, at the image's own pixels. Where the network sees a smaller
        image, only what it says of that is kept, and enlarged when a map is asked for. A constant
        image holds nothing to detect: its map is 0 throughout.
    """
    return compute_maps_of_batch([rgb], network, options)[0]


def compute_maps_of_batch(
    images: Sequence[np.ndarray], network: Network, options: HeatmapOptions = HeatmapOptions()
) -> list[Maps]:
    """Run the network once on several images.

    Args:
        images: (H, W, 3) uint8 RGB each, of which `seen_size` is the same.
        network, options: as of `compute_maps`.

    Returns:
        As `compute_maps`, of each image. Of images run together the last bits may be others.
    """
    maps: list[Maps | None] = [None] * len(images)
    together = []
    for number, rgb in enumerate(images):
        native = _is_native(rgb.shape, options)
        if not native and options.tile_megapixels != "auto":
            raise OptionError(
                "`tile_megapixels` needs `resolution='native'`: scaled images are small"
            )
        if _is_constant(rgb):
            maps[number] = Maps.of_logits(np.full(rgb.shape[:2], -np.inf, np.float32))
            continue
        seen = _seen(rgb, options)
        tiled = _tiled(network, rgb.shape[0] * rgb.shape[1], options) if native else None
        if tiled is None:
            together.append((number, seen))
            continue
        (logits,) = _mean_of_flips(partial(_run_tiled, tiled, options), [seen], options)
        maps[number] = Maps.of_logits(logits)
    if together:
        found = _mean_of_flips(partial(_run, network), [seen for _, seen in together], options)
        largest = max(images[number].shape[0] * images[number].shape[1] for number, _ in together)
        scaled = not _is_native(images[together[0][0]].shape, options)
        if scaled and largest > RELEASE_PIXELS and hasattr(network, "release_memory"):
            network.release_memory()
            release_freed_memory()
        for (number, _), logits in zip(together, found, strict=True):
            shape = images[number].shape[:2]
            native = _is_native(shape, options)
            maps[number] = Maps.of_logits(logits) if native else _enlarged(logits, shape)
    return [one for one in maps if one is not None]


@contextmanager
def memory_named(shape: tuple[int, ...], images: int = 1) -> Iterator[None]:
    """Make lack of memory, in work on images of this shape, an error of one sentence."""
    try:
        yield
        return
    except MemoryError:
        pass
    except Exception as error:
        if not is_lack_of_memory(error):
            raise
    height, width = shape[:2]
    if images > 1:
        raise DeepDetectError(
            f"there is not enough memory for {images} images of {width}x{height} pixels at once: "
            "use a smaller `batch_size`"
        )
    raise DeepDetectError(
        f"there is not enough memory for an image of {width}x{height} pixels: "
        "use `resolution='auto'`, fewer keypoints, or a smaller image"
    )


def seen_size(shape: tuple[int, ...], options: HeatmapOptions) -> tuple[int, int]:
    """Return the width and height at which the network sees an image of a shape (H, W, ...)."""
    height, width = shape[:2]
    if _is_native(shape, options):
        return width, height
    if options.resolution != "auto":
        return int(options.resolution), int(options.resolution)
    scale = (MAX_AUTO_PIXELS / (height * width)) ** 0.5
    width, height = (max(STRIDE, round(side * scale / STRIDE) * STRIDE) for side in (width, height))
    return width, height


def _is_native(shape: tuple[int, ...], options: HeatmapOptions) -> bool:
    """Return whether the network sees an image at its own size."""
    whole = shape[0] * shape[1] <= MAX_AUTO_PIXELS
    return options.resolution == "native" or (options.resolution == "auto" and whole)


def _seen(rgb: np.ndarray, options: HeatmapOptions) -> np.ndarray:
    """Return an image with the size and the order of channels that the network sees."""
    seen = rgb if options.network_channels == "rgb" else rgb[:, :, ::-1]
    if _is_native(rgb.shape, options):
        return seen
    kind = cv2.INTER_AREA if options.resolution == "auto" else cv2.INTER_CUBIC
    size = seen_size(rgb.shape, options)
    scaled: np.ndarray = cv2.resize(np.ascontiguousarray(seen), size, interpolation=kind)
    return scaled


def _enlarged(logits: np.ndarray, shape: tuple[int, ...]) -> Maps:
    """Return the maps of an image of a shape (H, W), of the logits of a scaled one."""

    def enlarged(map_: np.ndarray) -> np.ndarray:
        return cv2.resize(map_, shape[::-1], interpolation=cv2.INTER_CUBIC)

    def heatmap() -> Rows:
        map_ = enlarged(sigmoid(logits))
        return lambda rows: np.clip(map_[rows], 0, 1)

    return Maps(shape, heatmap, lambda: enlarged(logits))


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


def _run(network: Network, images: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the (H, W) logits of images of one size, each flip of which is padded by itself."""
    height, width = images[0].shape[:2]
    padded = [_pad(rgb) for rgb in images]
    planes = np.empty((len(images), 3, *padded[0].shape[:2]), np.float32)
    for rgb, into in zip(padded, planes, strict=True):
        np.multiply(rgb.transpose(2, 0, 1), np.float32(1 / 255), out=into)
    return [np.ascontiguousarray(logits[0, :height, :width]) for logits in network(planes)]


def _run_tiled(
    tiled: TiledNetwork, options: HeatmapOptions, images: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return the (H, W) logits of images, each run in tiles."""
    area = None if options.tile_megapixels == "auto" else float(options.tile_megapixels)
    return [tiled(rgb, area) for rgb in images]


def _mean_of_flips(
    run: Callable[[list[np.ndarray]], list[np.ndarray]],
    images: list[np.ndarray],
    options: HeatmapOptions,
) -> list[np.ndarray]:
    """Return the logits of images, with `tta` the mean of those of their flips and turns."""
    if options.tta == "none":
        return run(images)
    means = [np.zeros(rgb.shape[:2], np.float32) for rgb in images]
    for turns in range(4):
        turned = [np.rot90(rgb, turns) for rgb in images]
        for step in (1, -1):
            found = run([each[:, ::step] for each in turned])
            for mean, logits in zip(means, found, strict=True):
                mean += np.rot90(logits[:, ::step], -turns)
    for mean in means:
        mean /= 8
    return means
