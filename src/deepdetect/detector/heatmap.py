"""From an image to a heat map: for each pixel, the probability of a keypoint."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
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
"""Size of the largest image that the resolution "auto" takes as it is."""

RELEASE_PIXELS = 20_000_000
"""Above this size the maps need the memory that the network keeps; below it is not worth it."""

MIN_TILE_MEGAPIXELS = 1.5
"""Smaller tiles would be mostly overlap."""

Run = Callable[[list[np.ndarray]], list[np.ndarray]]
"""Maps images of one size, (H, W, 3) uint8, to their (H, W) logits."""


@suggest_keywords
@dataclass(frozen=True)
class HeatmapOptions:
    """How an image is shown to the network: the options of `DeepDetect` of these names.

    Attributes:
        resolution: "native", a number of pixels, or "auto", which scales larger images down since
            their finest pixels show blur and noise more than structure, and the network needs
            seconds and gigabytes for them.
        network_channels: "rgb"; "bgr" is what the paper's published code feeds, though the weights
            were trained on RGB. It says nothing of the images that are given.
        tta: "none"; "flip" takes the mean of the logits in eight flips and quarter turns.
        tile_megapixels: from 1.5 on; "auto": 2.7 where the image is too large for the free memory.
            Only ONNX weights of the network `fast` can be tiled.

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
    """Return whether the network sees an image of a shape (H, W, ...) at its own size."""
    small = shape[0] * shape[1] <= MAX_AUTO_PIXELS
    return options.resolution == "native" or (options.resolution == "auto" and small)


def seen_size(shape: tuple[int, ...], options: HeatmapOptions) -> tuple[int, int]:
    """Return the width and height at which the network sees an image of a shape (H, W, ...)."""
    height, width = shape[:2]
    if is_native(shape, options):
        return width, height
    if options.resolution != "auto":
        return int(options.resolution), int(options.resolution)
    scale = (MAX_AUTO_PIXELS / (height * width)) ** 0.5
    width, height = (max(1, round(side * scale / STRIDE)) for side in (width, height))
    return STRIDE * width, STRIDE * height


def compute_maps(
    images: Sequence[np.ndarray], network: Network, options: HeatmapOptions = HeatmapOptions()
) -> list[Maps]:
    """Run the network once on (H, W, 3) uint8 RGB images that it sees at one size.

    The maps are at the images' own pixels: scaled ones are enlarged when a map is asked for. A
    constant image holds nothing to detect: its map is 0. The last bits of images that are run
    together may be others.
    """
    logits: dict[int, np.ndarray] = {}
    together = []
    for number, rgb in enumerate(images):
        if all((rgb[rows] == rgb[0, 0]).all() for rows in bands(rgb.shape)):
            logits[number] = np.full(rgb.shape[:2], -np.inf, np.float32)
        elif tiled := _tiled(network, rgb.shape, options):
            (logits[number],) = _mean_of_flips(tiled, [_seen(rgb, options)], options)
        else:
            together.append(number)
    if together:
        seen = [_seen(images[number], options) for number in together]
        found = _mean_of_flips(partial(_run, network), seen, options)
        logits.update(zip(together, found, strict=True))
        shapes = [images[number].shape for number in together]
        large = max(height * width for height, width, _ in shapes) > RELEASE_PIXELS
        if large and not is_native(shapes[0], options) and hasattr(network, "release_memory"):
            network.release_memory()
            release_freed_memory()
    return [
        Maps.of_logits(logits[number])
        if logits[number].shape == rgb.shape[:2]
        else _enlarged(logits[number], rgb.shape[:2])
        for number, rgb in enumerate(images)
    ]


@contextmanager
def memory_named(shape: tuple[int, ...], images: int = 1) -> Iterator[None]:
    """Make lack of memory, in work on images of this shape, an error of one sentence."""
    try:
        yield
    except Exception as error:
        if not (isinstance(error, MemoryError) or is_lack_of_memory(error)):
            raise
        size = f"{shape[1]}x{shape[0]} pixels"
        raise DeepDetectError(
            f"there is not enough memory for {images} images of {size} at once: "
            "use a smaller `batch_size`"
            if images > 1
            else f"there is not enough memory for an image of {size}: "
            "use `resolution='auto'`, fewer keypoints, or a smaller image"
        ) from None


def _seen(rgb: np.ndarray, options: HeatmapOptions) -> np.ndarray:
    """Return an image with the size and the order of channels that the network sees."""
    seen = rgb if options.network_channels == "rgb" else rgb[:, :, ::-1]
    if is_native(rgb.shape, options):
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


def _tiled(network: Network, shape: tuple[int, ...], options: HeatmapOptions) -> Run | None:
    """Return what runs the network in tiles, or None for an image that is run whole."""
    path = getattr(network, "onnx_path", None)  # torch, bfloat16 and others run whole
    area = None if options.tile_megapixels == "auto" else float(options.tile_megapixels)
    most = available_memory() / BYTES_PER_PIXEL if area is None else area * 1e6
    if not is_native(shape, options) or shape[0] * shape[1] <= most:
        return None
    tiled = None if path is None else open_tiled(path, network.threads)  # type: ignore[attr-defined]
    if tiled is not None:
        return lambda images: [tiled(rgb, area) for rgb in images]
    if area is None:
        return None
    raise OptionError(
        "this network cannot be run in tiles: leave `tile_megapixels` out, or use ONNX weights of "
        "the network fast, in float32"
    )


def _run(network: Network, images: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the (H, W) logits of images of one size, padded to multiples of 8."""
    height, width = images[0].shape[:2]
    full = (height + -height % STRIDE, width + -width % STRIDE)
    planes = np.empty((len(images), 3, *full), np.float32)
    for rgb, into in zip(images, planes, strict=True):
        fill_planes(rgb, into)
    return [np.ascontiguousarray(logits[0, :height, :width]) for logits in network(planes)]


def _mean_of_flips(run: Run, images: list[np.ndarray], options: HeatmapOptions) -> list[np.ndarray]:
    if options.tta == "none":
        return run(images)
    means = [np.zeros(rgb.shape[:2], np.float32) for rgb in images]
    for turns in range(4):
        turned = [np.rot90(rgb, turns) for rgb in images]
        for step in (1, -1):
            found = run([each[:, ::step] for each in turned])
            for mean, logits in zip(means, found, strict=True):
                mean += np.rot90(logits[:, ::step], -turns)
    return [mean / np.float32(8) for mean in means]
