"""The network on images that are too large for the memory: in parts, and each part in tiles.

A logit depends on pixels up to 1,738 px away, most of it through the zeros that pad the layers
at an eighth of the size, so tiles of the image alone would either differ from the whole at their
seams or overlap almost entirely. Cut into parts, no layer reaches far: each part runs on tiles
that overlap by as much as it sees, and the logits are those of the whole image.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from .._shared.errors import DeepDetectError, first_line
from .._shared.machine import release_freed_memory
from .._shared.progress import progress
from .backends.onnx_parts import cut_onnx
from .backends.onnxruntime_backend import start_session
from .pretrained import STRIDE

BLOCKS = 9
"""Pyramids at an eighth of the size."""

_ENCODER = "/network/encoder"
REDUCED = f"{_ENCODER}/level3_0/c1/conv/Conv_output_0"
QUARTER = "/network/level3_C/conv/Conv_output_0"
EIGHTH = "/network/classifier/conv/Conv_output_0"
STAGES = (
    f"{_ENCODER}/level3_0/act/PRelu_output_0",
    *(f"{_ENCODER}/level3.{k}/bn/act/PRelu_output_0" for k in range(BLOCKS)),
)
"""Tensors at which the network is cut, as `export_onnx` names them."""

START_MARGIN_PX = 416
"""How far `REDUCED` and `QUARTER` see, rounded up: six pyramids of 64 pixels, and kernels."""

BLOCK_MARGIN = 16
"""How far a pyramid sees at an eighth of the size: its largest dilation."""

END_MARGIN_PX = 80
"""How far the logits see in what they are computed from: a pyramid of 64 pixels, and kernels."""

DEFAULT_TILE_MEGAPIXELS = 2.7

Part = Callable[..., list[np.ndarray]]
Reader = Callable[[slice, slice], np.ndarray]
"""Gives the tile of an input at rows and columns, which are counted in strides."""


@dataclass(frozen=True)
class TiledNetwork:
    """A network in parts.

    The image gives `start`, the reduced features at an eighth and those at a quarter of the size.
    `blocks` and `middle` give the decoder's at an eighth. `end` makes logits of the image and the
    last two.
    """

    start: Part
    blocks: tuple[Part, ...]
    middle: Part
    end: Part

    def __call__(self, rgb: np.ndarray, tile_megapixels: float | None = None) -> np.ndarray:
        """Compute the (H, W) float32 logits of (H, W, 3) uint8, in tiles of so many megapixels."""
        side = int((1e6 * (tile_megapixels or DEFAULT_TILE_MEGAPIXELS)) ** 0.5)
        height, width = rgb.shape[:2]
        size = (-(-height // STRIDE), -(-width // STRIDE))
        image: Reader = functools.partial(_planes, rgb)
        margin = START_MARGIN_PX // STRIDE
        reduced, quarter = _in_tiles(self.start, [image], (1, 2), size, side // STRIDE, margin)
        margin = BLOCK_MARGIN * (BLOCKS + 1)
        (eighth,) = _in_tiles(self._blocks, [_reader(reduced)], (1,), size, side // 2, margin)
        del reduced
        inputs = [image, _reader(quarter, 2), _reader(eighth)]
        # Beside the logits there is less room, and these overlap little.
        margin = END_MARGIN_PX // STRIDE
        (logits,) = _in_tiles(self.end, inputs, (STRIDE,), size, side // (2 * STRIDE), margin)
        del quarter, eighth, inputs
        release_freed_memory()
        return np.ascontiguousarray(logits[0, 0, :height, :width])

    def _blocks(self, reduced: np.ndarray) -> list[np.ndarray]:
        """Run the blocks and the middle on a tile of the reduced features."""
        features = _in_bands(self.blocks[0], reduced)
        for block in self.blocks[1:]:
            _in_bands(block, features, into=features)
        release_freed_memory()
        return [_in_bands(self.middle, reduced, features)]


def open_tiled(path: Path, threads: int | None = None) -> TiledNetwork | None:
    """Cut the network of an ONNX file into parts; None where it is built otherwise than ours."""
    state = path.stat()
    return _open(path.absolute(), threads, (state.st_mtime_ns, state.st_size))


@functools.lru_cache(maxsize=2)
def _open(path: Path, threads: int | None, state: tuple[int, int]) -> TiledNetwork | None:
    model = path.read_bytes()

    def part(inputs: tuple[str, ...], outputs: tuple[str, ...]) -> Part:
        # Kept memory would add up over the parts.
        session = start_session(cut_onnx(model, inputs, outputs), threads, keep_memory=False)

        def run(*given: np.ndarray) -> list[np.ndarray]:
            try:
                found: list[np.ndarray] = session.run(None, dict(zip(inputs, given, strict=True)))
            except Exception as error:  # its exceptions share no base class
                raise DeepDetectError(
                    f"the network failed on a tile ({first_line(error)}), most likely for "
                    "lack of memory: use a smaller `tile_megapixels`, or `resolution='auto'`"
                ) from None
            return found

        return run

    chain = (REDUCED, *STAGES)
    try:
        return TiledNetwork(
            part(("image",), (REDUCED, QUARTER)),
            tuple(part((a,), (b,)) for a, b in zip(chain[:-1], STAGES, strict=True)),
            part((REDUCED, STAGES[-1]), (EIGHTH,)),
            part(("image", QUARTER, EIGHTH), ("logits",)),
        )
    except Exception:  # parts that are not there or not alone in the file: it is run whole
        return None


def _in_tiles(
    part: Part,
    inputs: Sequence[Reader],
    scales: tuple[int, ...],
    size: tuple[int, int],
    side: int,
    margin: int,
) -> list[np.ndarray]:
    """Run a part on tiles of its inputs, and join its outputs.

    Size, side and margin are counted in strides, in which an output is so many times as large.
    """
    outputs: list[np.ndarray] = []
    tiles = list(product(*(_spans(length, side, margin) for length in size)))
    release_freed_memory()
    with progress(len(tiles), "network", "tile", quiet=not sys.stderr.isatty()) as bar:
        for (seen_rows, rows, inner_rows), (seen_columns, columns, inner_columns) in tiles:
            found = part(*(read(seen_rows, seen_columns) for read in inputs))
            if not outputs:
                outputs = [
                    np.empty((1, tile.shape[1], *(scale * length for length in size)), np.float32)
                    for tile, scale in zip(found, scales, strict=True)
                ]
            for output, tile, scale in zip(outputs, found, scales, strict=True):
                inner = tile[:, :, _times(inner_rows, scale), _times(inner_columns, scale)]
                output[:, :, _times(rows, scale), _times(columns, scale)] = inner
            del found, tile, inner  # before those of the next tile are made
            release_freed_memory()
            bar.update(1)
    return outputs


def _in_bands(part: Part, *given: np.ndarray, into: np.ndarray | None = None) -> np.ndarray:
    """Run a part at an eighth of the size in bands of rows.

    `into` may be the input itself, which is then overwritten.
    """
    # With one input it is a pyramid; what joins two has three times as many channels.
    height, rows = given[0].shape[2], 2 * BLOCK_MARGIN if len(given) == 1 else BLOCK_MARGIN
    above = [each[:, :, :0] for each in given]
    for start in range(0, height, rows):
        stop, seen = min(start + rows, height), min(start + rows + BLOCK_MARGIN, height)
        band = [
            np.concatenate([before, each[:, :, start:seen]], 2)
            for before, each in zip(above, given, strict=True)
        ]
        (found,) = part(*band)
        if into is None:
            into = np.empty((1, found.shape[1], *given[0].shape[2:]), np.float32)
        first = above[0].shape[2]
        last = slice(max(0, stop - BLOCK_MARGIN), stop)
        above = [each[:, :, last].copy() for each in given]  # before it is replaced
        into[:, :, start:stop] = found[:, :, first : first + stop - start]
    assert into is not None
    return into


def _spans(length: int, side: int, margin: int) -> list[tuple[slice, slice, slice]]:
    """Divide a length into as few equal parts as possible that, with margins, fit into a side.

    Of each: the slice that is read, the one that is written, and where that lies in the first.
    """
    count = 1
    while (core := -(-length // count)) + margin * min(count - 1, 2) > side and core > margin:
        count += 1
    spans = []
    for first in range(0, length, core):
        last = min(first + core, length)
        start, stop = max(0, first - margin), min(length, last + margin)
        spans.append((slice(start, stop), slice(first, last), slice(first - start, last - start)))
    return spans


def _times(span: slice, scale: int) -> slice:
    return slice(span.start * scale, span.stop * scale)


def _reader(features: np.ndarray, scale: int = 1) -> Reader:
    return lambda rows, columns: np.ascontiguousarray(
        features[:, :, _times(rows, scale), _times(columns, scale)]
    )


def _planes(rgb: np.ndarray, rows: slice, columns: slice) -> np.ndarray:
    """Return (1, 3, H, W) float32 of a tile."""
    height, width = STRIDE * (rows.stop - rows.start), STRIDE * (columns.stop - columns.start)
    planes = np.empty((1, 3, height, width), np.float32)
    fill_planes(rgb[_times(rows, STRIDE), _times(columns, STRIDE)], planes[0])
    return planes


def fill_planes(rgb: np.ndarray, planes: np.ndarray) -> None:
    """Write (H, W, 3) uint8 to larger (3, H, W) float32: the last row and column are repeated."""
    below, right = planes.shape[1] - rgb.shape[0], planes.shape[2] - rgb.shape[1]
    if below or right:
        rgb = np.pad(rgb, ((0, below), (0, right), (0, 0)), mode="edge")
    np.multiply(rgb.transpose(2, 0, 1), np.float32(1 / 255), out=planes)
