"""Running the network `fast` in tiles, for images whose computation would not fit in memory.

The network uses a few numbers about the whole image: the exposure, computed from every 8th row and
column, and means and maxima of features, collected by a first pass over the tiles. A second pass
computes the logits. Tiles overlap by more than the receptive field of the convolutions, so the
logits are the same as without tiles. (ESPNet cannot be tiled: it needs pixels up to 1,738 px away.)
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .._shared.errors import DeepDetectError, first_line
from .._shared.image_array import fill_planes
from .._shared.machine import release_freed_memory
from .._shared.progress import STDERR, progress
from .._shared.runtimes import start_session
from ..io.image import luma
from .backends.onnx_parts import cut_onnx
from .pretrained import LOGITS, STRIDE

COUNTED = "/network/exposure/Slice_1_output_0"
LIGHT = ("/network/exposure/ReduceMean_output_0", "/network/Exp_output_0")
FEATURES = (
    "/network/encode_half/encode_half.1/Relu_output_0",
    "/network/encode_quarter/Relu_output_0",
    "/network/encode_eighth/encode_eighth.1/Relu_output_0",
)
AVERAGES, MAXIMA = (
    tuple(f"/network/Global{kind}Pool{number}_output_0" for number in ("", "_1", "_2"))
    for kind in ("Average", "Max")
)
THRESHOLDS = "/network/thresholds/Unsqueeze_1_output_0"
"""The constants from `COUNTED` to `THRESHOLDS` name the tensors at which the network is cut."""

SCALES, MARGIN = (4, 2, 1), 4
"""The three feature maps have SCALES rows and columns per stride of 8 px. A tile is read with a
border of MARGIN strides, because convolutions need pixels up to 28 px away."""

BYTES_PER_PIXEL, DEFAULT_TILE_MEGAPIXELS = 90, 2.7
"""A run without tiles takes about BYTES_PER_PIXEL bytes of memory per pixel in ONNX Runtime or
OpenVINO. DEFAULT_TILE_MEGAPIXELS is the default size of a tile, chosen by hand."""

Part = Callable[..., list[np.ndarray]]


@dataclass(frozen=True)
class TiledNetwork:
    """A network cut into four parts.

    `expose` maps the subsampled luma of the image to its mean and the exposure gain. `encode` maps
    a tile, the mean and the gain to features. `threshold` maps the subsampled luma, and the means
    and maxima of the features over all tiles, to thresholds. `decode` maps a tile, the mean, the
    gain and the thresholds to logits.
    """

    expose: Part
    encode: Part
    threshold: Part
    decode: Part

    def __call__(self, rgb: np.ndarray, tile_megapixels: float | None = None) -> np.ndarray:
        """Compute the (H, W) float32 logits of an image, (H, W, 3) uint8, in tiles."""
        side = int((1e6 * (tile_megapixels or DEFAULT_TILE_MEGAPIXELS)) ** 0.5) // STRIDE
        height, width = (-(-length // STRIDE) for length in rgb.shape[:2])
        tiles = list(product(_spans(height, side), _spans(width, side)))
        counted = luma(np.ascontiguousarray(rgb[::STRIDE, ::STRIDE]))[None, None] / np.float32(255)
        light = self.expose(counted)
        sums = [np.zeros(())] * len(SCALES)
        maxima = [np.full((), -np.inf, np.float32)] * len(SCALES)
        logits = np.empty(rgb.shape[:2], np.float32)
        release_freed_memory()
        with progress(2 * len(tiles), "network", "tile", quiet=not STDERR.isatty()) as bar:
            for rows, columns in tiles:
                features = self.encode(_planes(rgb, rows.seen, columns.seen), *light)
                for k, (each, scale) in enumerate(zip(features, SCALES, strict=True)):
                    core = each[:, :, _times(rows.inner, scale), _times(columns.inner, scale)]
                    sums[k] = sums[k] + core.sum((2, 3), np.float64, keepdims=True)
                    maxima[k] = np.maximum(maxima[k], core.max((2, 3), keepdims=True))
                bar.update(1)
            counts = height * width * np.square(SCALES)
            averages = [
                (s / count).astype(np.float32) for s, count in zip(sums, counts, strict=True)
            ]
            thresholds = self.threshold(counted, *averages, *maxima)
            for rows, columns in tiles:
                (found,) = self.decode(_planes(rgb, rows.seen, columns.seen), *light, *thresholds)
                inner = _times(rows.inner, STRIDE), _times(columns.inner, STRIDE)
                logits[_times(rows.core, STRIDE), _times(columns.core, STRIDE)] = found[0, 0][inner]
                bar.update(1)
        release_freed_memory()
        return logits


def open_tiled(path: Path, threads: int | None = None) -> TiledNetwork | None:
    """Cut the network of an ONNX file into parts; return None if it is not the network `fast`."""
    state = path.stat()
    return _open(path.absolute(), threads, (state.st_mtime_ns, state.st_size))


@functools.lru_cache(maxsize=2)
def _open(path: Path, threads: int | None, state: tuple[int, int]) -> TiledNetwork | None:
    model = path.read_bytes()

    def part(inputs: tuple[str, ...], outputs: tuple[str, ...]) -> Part:
        # The memory that each session keeps between runs would add up over the four parts.
        session = start_session(cut_onnx(model, inputs, outputs), threads, keep_memory=False)

        def run(*given: np.ndarray) -> list[np.ndarray]:
            try:
                found: list[np.ndarray] = session.run(None, dict(zip(inputs, given, strict=True)))
            except Exception as error:  # the runtime's exceptions share no base class
                raise DeepDetectError(
                    f"the network failed on a tile ({first_line(error)}), most likely for "
                    "lack of memory: use a smaller `tile_megapixels`, or `resolution='auto'`"
                ) from None
            return found

        return run

    try:
        return TiledNetwork(
            part((COUNTED,), LIGHT),
            part(("image", *LIGHT), FEATURES),
            part((COUNTED, *AVERAGES, *MAXIMA), (THRESHOLDS,)),
            part(("image", *LIGHT, THRESHOLDS), (LOGITS,)),
        )
    except Exception:  # another network: a tensor is missing, or depends on further inputs
        return None


class _Span(NamedTuple):
    """The extent of a tile along one axis, in strides of 8 pixels.

    The network reads `seen` and fills `core`. `inner` is the position of `core` within `seen`.
    """

    seen: slice
    core: slice
    inner: slice


def _spans(length: int, side: int) -> list[_Span]:
    """Divide a length into the fewest equal parts that, with margins, are at most `side` long."""
    count = 1
    while (core := -(-length // count)) + MARGIN * min(count - 1, 2) > side and core > MARGIN:
        count += 1
    spans = []
    for first in range(0, length, core):
        last = min(first + core, length)
        start, stop = max(0, first - MARGIN), min(length, last + MARGIN)
        inner = slice(first - start, last - start)
        spans.append(_Span(slice(start, stop), slice(first, last), inner))
    return spans


def _times(span: slice, scale: int) -> slice:
    return slice(span.start * scale, span.stop * scale)


def _planes(rgb: np.ndarray, rows: slice, columns: slice) -> np.ndarray:
    """Return the tile of these rows and columns, in strides, as (1, 3, H, W) float32 in [0, 1]."""
    tile = rgb[_times(rows, STRIDE), _times(columns, STRIDE)]
    planes = np.empty((1, 3, *tile.shape[:2]), np.float32)
    fill_planes(tile, planes[0])
    return planes
