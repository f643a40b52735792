"""TIFF files as tifffile writes them, with tags of all kinds: as it reads them, or refused."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from deepdetect import load_image

from ..case import Target, expect

TYPES = ("u1", "u2", "u4", "i1", "i2", "f2", "f4", "f8", "bool")
TOP = {"u1": 255, "u2": 65535, "u4": 2**32 - 1, "i1": 127, "i2": 32767}


def tiff_files(generator: np.random.Generator) -> tuple[bytes, dict[str, Any]]:
    """Return a TIFF file of random tags, and options of `load_image` for it."""

    def one(*values: Any) -> Any:
        return values[int(generator.integers(len(values)))]

    kind = one(*TYPES)
    count, height, width = one(1, 1, 3, 3, 2, 4, 5, 7), *generator.integers(16, 60, 2)
    white = one(1.0, 1.0, 1 / 16, 1 / 64) if kind == "u2" else 1.0
    values = generator.random((height, width, count)) * TOP.get(kind, 1) * white
    values = values > 0.5 if kind == "bool" else values.astype(kind)
    planar = one("contig", "separate") if count > 1 else None
    if count == 1:
        values = values[:, :, 0]
    elif planar == "separate":
        values = np.ascontiguousarray(np.moveaxis(values, 2, 0))
    compression = one(None, None, "zlib", "lzw", "packbits", "zstd")
    how: dict[str, Any] = {
        "photometric": one("minisblack", "miniswhite", *(["rgb"] * 2 if count >= 3 else [])),
        "planarconfig": planar,
        "byteorder": one("<", ">"),
        "bigtiff": one(True, False),
        "compression": compression,
        "tile": one(None, (16, 16), (32, 16)),
        "extratags": [],
    }
    if how["tile"] is None:
        how["rowsperstrip"] = one(None, 1, 7)
    if compression in ("zlib", "lzw", "zstd") and kind != "bool":
        how["predictor"] = one(True, False)
    if count == 1 and kind == "u1" and one(True, False):
        how["photometric"] = "palette"
        how["colormap"] = generator.integers(0, 256, (3, 256)).astype(np.uint16) * one(256, 257)
    if count in (2, 4, 5) and how["photometric"] != "palette":
        extra = count - (3 if how["photometric"] == "rgb" else 1)
        how["extrasamples"] = [one("unspecified", "unassalpha")] * extra if extra > 0 else None
    if one(True, False, False):
        how["extratags"].append((42113, "s", 0, str(one(0, 7, 255, 0.5, "nan")), True))
    if one(True, False, False):
        how["extratags"].append((274, 3, 1, int(generator.integers(1, 9)), True))
    pages = one(1, 1, 2)
    file = io.BytesIO()
    with tifffile.TiffWriter(
        file, bigtiff=how.pop("bigtiff"), byteorder=how.pop("byteorder")
    ) as tif:
        if one(True, False, False, False):
            tif.write(np.zeros((16, 16), np.uint8), subfiletype=1)
        for page in range(pages):
            tif.write(values[::-1].copy() if page else values, metadata=None, **how)
    options: dict[str, Any] = {}
    if pages == 2 and one(True, False):
        options["page"] = 1
    if count > 1 and one(True, False):
        options["bands"] = tuple(int(each) for each in generator.integers(1, count + 1, 3))
    if one(True, False):
        top = TOP.get(kind, 1)
        options["value_range"] = one((0, top), (-top / 2, top / 2), (0, top / 16))
    return file.getvalue(), options


def expected_rgb(
    content: bytes,
    page: int = 0,
    bands: tuple[int, ...] | None = None,
    value_range: tuple[float, float] | None = None,
) -> np.ndarray:
    """Return the image by tifffile's own reading, and what its documentation leaves to others."""
    with tifffile.TiffFile(io.BytesIO(content)) as tif:
        own = [each for each in tif.pages if not each.is_reduced][page]
        values, photometric, dtype = own.asarray(), own.photometric.name, own.dtype
        if own.axes.startswith("S"):
            values = np.moveaxis(values, 0, 2)
        values = values.reshape(*values.shape[:2], -1)
        nodata = own.tags.get(42113)
        orientation = own.tags.get(274)
        colormap = own.colormap
        extra = [int(each) for each in own.extrasamples]
        alpha = values[:, :, extra.index(2) - len(extra)] if 2 in extra else None
        colours = 3 if photometric == "RGB" else values.shape[2] - (values.shape[2] in (2, 4))
    values = values[:, :, [each - 1 for each in bands]] if bands else values[:, :, :colours]
    absent = np.zeros(values.shape, bool)
    if nodata is not None:
        absent = values == float(nodata.value)
    hidden = absent.all(axis=2, keepdims=True)
    exact = np.where(absent if dtype.kind == "f" else hidden, 0, values).astype(np.float64)
    if photometric == "PALETTE":
        rgb = np.moveaxis(colormap[:, values[:, :, 0]] // 256, 0, 2)
    else:
        low, high = value_range or (0.0, float(TOP.get(dtype.str[1:], 1)))
        if value_range is None and dtype == np.uint16:
            high = next(2.0**bits - 1 for bits in (8, 10, 12, 14, 16) if exact.max() < 2**bits)
        level = ((exact - low) * (255 / (high - low))).clip(0, 255)
        rgb = np.rint(level) if value_range or dtype.kind == "f" else np.floor(level + 0.5)
        rgb = 255 - rgb if photometric == "MINISWHITE" else rgb
    rgb = np.repeat(rgb, 3, axis=2) if rgb.shape[2] == 1 else rgb
    share = np.ones(rgb.shape[:2])
    if alpha is not None:
        share = alpha / (255 if alpha.dtype == np.uint8 else max(alpha.max(initial=0), 1))
    share = np.where(hidden[..., 0], 0, share).clip(0, 1)
    if (share >= 0.5).any():  # otherwise alpha tells nothing
        share = np.where(share < 0.5, 0, share)[..., None]
        rgb = np.rint(rgb * share + 128 * (1 - share))
    turns = {1: (0, 0), 2: (0, 1), 3: (2, 0), 4: (2, 1), 5: (1, 2), 6: (3, 0), 7: (3, 2), 8: (1, 0)}
    turn, flip = turns[int(orientation.value) if orientation else 1]
    if flip == 2:  # transposed
        return np.swapaxes(rgb if turn == 1 else rgb[::-1, ::-1], 0, 1).astype(np.uint8)
    return np.rot90(rgb[:, ::-1] if flip else rgb, turn).astype(np.uint8)


def tagged(generator: np.random.Generator, folder: Path) -> None:
    """Read a TIFF file of random tags, which is right or refused."""
    content, options = tiff_files(generator)
    found = load_image(content, **options)
    same = np.array_equal(found, expected_rgb(content, **options))
    expect(same, f"other pixels than tifffile reads, with {options}")


TARGETS = (Target("tags", "TIFF files of all tags, against tifffile", tagged, 2000),)
