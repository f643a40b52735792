"""The network on images that are too large for the memory: in parts, and each part in tiles.

A logit depends on pixels up to `REACH_PX` away, most of it through the zeros that pad the layers
at an eighth of the size, so tiles of the image alone would either differ from the whole at their
seams or overlap almost entirely. Cut into parts, no layer reaches far: each part runs on tiles
that overlap by as much as it sees, and the logits are those of the whole image.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import DeepDetectError
from .._shared.memory import release_freed_memory
from .._shared.progress import progress
from .backends.onnx_parts import cut_onnx
from .backends.without_telemetry import import_onnxruntime

STRIDE = 8

REACH_PX = 1744
"""How far the whole network sees, rounded up: seven pyramids of 64 pixels, ten of 128, and kernels.

`4679d01:benchmarks/receptive_field.py` measures it.
"""

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
Span = tuple[slice, slice, slice]


@dataclass(frozen=True)
class TiledNetwork:
    """A network in parts.

    Attributes:
        start: of the image, the reduced features at an eighth and at a quarter of the size.
        blocks: one after the other on the features at an eighth of the size.
        middle: of the reduced features and those of the last block, the decoder's.
        end: of the image and the decoder's features at a quarter and an eighth, the logits.
    """

    start: Part
    blocks: tuple[Part, ...]
    middle: Part
    end: Part

    def __call__(self, rgb: np.ndarray, tile_megapixels: float | None = None) -> np.ndarray:
        """Compute the logits.

        Args:
            rgb: (H, W, 3) uint8, of any size; it is padded as `compute_maps` does.
            tile_megapixels: how much of the image is run at a time; None: 2.7.

        Returns:
            (H, W) float32.
        """
        side = int((1e6 * (tile_megapixels or DEFAULT_TILE_MEGAPIXELS)) ** 0.5)
        height, width = (-(-length // STRIDE) for length in rgb.shape[:2])
        starts = list(_tiles(height, width, side // STRIDE, START_MARGIN_PX // STRIDE))
        middles = list(_tiles(height, width, side // 2, BLOCK_MARGIN * (BLOCKS + 1)))
        # Beside the logits there is less room, and these overlap little.
        ends = list(_tiles(height, width, side // (2 * STRIDE), END_MARGIN_PX // STRIDE))
        total = len(starts) + len(middles) * len(self.blocks) + len(ends)
        release_freed_memory()
        with progress(total, "network", "tile", quiet=not sys.stderr.isatty()) as bar:
            reduced, quarter = self._run_start(rgb, height, width, starts, bar)
            release_freed_memory()
            eighth = self._run_middle(reduced, middles, bar)
            del reduced
            release_freed_memory()
            logits = self._run_end(rgb, quarter, eighth, ends, bar)
        del quarter, eighth
        release_freed_memory()
        return logits

    def _run_start(
        self, rgb: np.ndarray, height: int, width: int, tiles: list[tuple[Span, Span]], bar: Any
    ) -> tuple[np.ndarray, np.ndarray]:
        reduced, quarter = np.empty(0), np.empty(0)
        for row, column in tiles:
            found = self.start(_planes(rgb, row[0], column[0]))
            if not reduced.size:
                reduced = np.empty((1, found[0].shape[1], height, width), np.float32)
                quarter = np.empty((1, found[1].shape[1], 2 * height, 2 * width), np.float32)
            for whole, part, scale in ((reduced, found[0], 1), (quarter, found[1], 2)):
                _place(whole, part, row, column, scale)
            bar.update(1)
        return reduced, quarter

    def _run_middle(
        self, reduced: np.ndarray, tiles: list[tuple[Span, Span]], bar: Any
    ) -> np.ndarray:
        eighth = np.empty(0)
        for row, column in tiles:
            given = reduced[:, :, row[0], column[0]]
            features = _in_bands(self.blocks[0], given)
            for block in self.blocks[1:]:
                bar.update(1)
                _in_bands(block, features, into=features)
            release_freed_memory()
            found = _in_bands(self.middle, given, features)
            if not eighth.size:
                eighth = np.empty((1, found.shape[1], *reduced.shape[2:]), np.float32)
            _place(eighth, found, row, column, 1)
            bar.update(1)
            del features, found  # before those of the next tile are made
            release_freed_memory()
        return eighth

    def _run_end(
        self,
        rgb: np.ndarray,
        quarter: np.ndarray,
        eighth: np.ndarray,
        tiles: list[tuple[Span, Span]],
        bar: Any,
    ) -> np.ndarray:
        logits = np.empty(rgb.shape[:2], np.float32)
        for row, column in tiles:
            (found,) = self.end(
                _planes(rgb, row[0], column[0]),
                np.ascontiguousarray(quarter[:, :, _times(row[0], 2), _times(column[0], 2)]),
                np.ascontiguousarray(eighth[:, :, row[0], column[0]]),
            )
            into = logits[_times(row[1], STRIDE), _times(column[1], STRIDE)]
            inner = found[0, 0, _times(row[2], STRIDE), _times(column[2], STRIDE)]
            into[...] = inner[: into.shape[0], : into.shape[1]]
            bar.update(1)
        return logits


def open_tiled(path: Path, threads: int | None = None) -> TiledNetwork | None:
    """Cut the network of an ONNX file into parts; None where it is built otherwise than ours."""
    state = path.stat()
    return _open(path.absolute(), threads, (state.st_mtime_ns, state.st_size))


@functools.lru_cache(maxsize=2)
def _open(path: Path, threads: int | None, state: tuple[int, int]) -> TiledNetwork | None:
    model = path.read_bytes()
    onnxruntime = import_onnxruntime()
    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = 4
    # Kept memory would add up over the parts.
    settings.enable_cpu_mem_arena = False
    settings.enable_mem_pattern = False
    if threads is not None:
        settings.intra_op_num_threads = threads

    def part(inputs: tuple[str, ...], outputs: tuple[str, ...]) -> Part:
        session = onnxruntime.InferenceSession(
            cut_onnx(model, inputs, outputs), settings, providers=["CPUExecutionProvider"]
        )

        def run(*given: np.ndarray) -> list[np.ndarray]:
            try:
                found: list[np.ndarray] = session.run(None, dict(zip(inputs, given, strict=True)))
            except Exception as error:  # its exceptions share no base class
                raise DeepDetectError(
                    f"the network failed on a tile ({str(error).splitlines()[0]}), most likely for "
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


def _in_bands(part: Part, *given: np.ndarray, into: np.ndarray | None = None) -> np.ndarray:
    """Run a part at an eighth of the size in bands of rows.

    `into` may be what is given, which is then replaced.
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


def _tiles(height: int, width: int, side: int, margin: int) -> Iterator[tuple[Span, Span]]:
    """Yield rows and columns of tiles: what is seen, what is written, and where that lies in it."""
    return product(_spans(height, side, margin), _spans(width, side, margin))


def _spans(length: int, side: int, margin: int) -> list[Span]:
    """Divide a length into as few equal parts as are, with their margins, at most a side long."""
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


def _place(whole: np.ndarray, part: np.ndarray, row: Span, column: Span, scale: int) -> None:
    """Copy the inner pixels of a tile to their places."""
    inner = part[:, :, _times(row[2], scale), _times(column[2], scale)]
    whole[:, :, _times(row[1], scale), _times(column[1], scale)] = inner


def _planes(rgb: np.ndarray, rows: slice, columns: slice) -> np.ndarray:
    """Return (1, 3, H, W) float32 of a tile; beyond the image its last row and column go on."""
    height, width = STRIDE * (rows.stop - rows.start), STRIDE * (columns.stop - columns.start)
    tile = rgb[_times(rows, STRIDE), _times(columns, STRIDE)]
    missing = (height - tile.shape[0], width - tile.shape[1])
    if any(missing):
        tile = np.pad(tile, ((0, missing[0]), (0, missing[1]), (0, 0)), mode="edge")
    planes = np.empty((1, 3, height, width), np.float32)
    np.multiply(tile.transpose(2, 0, 1), np.float32(1 / 255), out=planes[0])
    return planes
