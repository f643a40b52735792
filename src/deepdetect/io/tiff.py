"""Reading TIFF files: the choice of the page, and the conversion of its values to RGB.

If a tag changes the meaning of pixels, the tag is respected, or an error names it.
"""

from __future__ import annotations

import io
import logging
import os
from contextlib import suppress
from itertools import takewhile
from typing import Any, BinaryIO

import numpy as np

from .._shared.alpha import on_grey
from .._shared.errors import ImageError, MissingExtraError
from .._shared.image_array import array_to_pixels
from .image_file import ReadingOptions, damaged_image, develop, identify, open_file

TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

MIN_IS_WHITE, MIN_IS_BLACK, RGB, PALETTE, CMYK, YCBCR = 0, 1, 2, 3, 5, 6
"""Codes of photometric interpretations that are read."""

MOSAICS = (32803, 34892)
"""Photometric interpretations of raw photographs: a colour filter array, and linear raw."""

JPEG = (6, 7)
"""Codes of JPEG compression, the only compression with which YCbCr is read."""

ALPHA = (1, 2)
"""Codes of extra samples that are alpha. If it is 1, colours are already multiplied by alpha."""
ORIENTATION, MAX_SAMPLE_VALUE, NO_DATA = 274, 281, 42113
"""Codes of TIFF tags. NO_DATA is defined by GDAL."""

MAX_BYTES_PER_PIXEL = 256
"""Files with more bytes per pixel are rejected, since small files can claim any number of bands."""


def read_tiff(
    file: BinaryIO, name: str, options: ReadingOptions, deep: bool, raw: bool = False
) -> tuple[np.ndarray, int]:
    """Read an image of a TIFF file.

    Returns:
        (H, W, 3) RGB or (H, W, 4) with alpha, not yet turned upright, and the EXIF orientation.
        RGB is uint8, or uint16 if `deep` and the file has more than 8 bits per value. If `raw`, all
        bands of a grey or RGB file are returned instead, (H, W, C), in their own data type.

    Raises:
        ImageError: as in `load_image`.
        MissingExtraError: it is a raw photograph, or its compression needs imagecodecs.
    """
    from tifffile import TiffFile

    logger = logging.getLogger("tifffile")
    if not logger.handlers:  # otherwise tifffile writes to standard error
        logger.addHandler(logging.NullHandler())
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    with TiffFile(file, name="image.tif") as tiff:
        stored = [*tiff.pages]
        page = chosen_page(stored, name, options)
        options.check_size(name, (page.imagewidth, page.imagelength))
        photometric = _checked_kind(page, name)
        if photometric in MOSAICS or stored[0].is_dng:
            return np.asarray(develop(file, name)), 1
        last = max(map(sum, zip(page.dataoffsets, page.databytecounts, strict=False)), default=0)
        if last > size:
            if not options.allow_truncated:
                raise damaged_image(name, f"{last - size:,} bytes are missing at its end")
            file.seek(0)
            filled = io.BytesIO(file.read() + bytes(last - size))
            return read_tiff(filled, name, options, deep, raw)
        orientation = int(page.tags.valueof(ORIENTATION, 1))
        try:
            array = page.asarray(squeeze=False)
        except Exception as error:  # tifffile and its decoders raise many types of errors
            if "imagecodecs" not in str(error) and not isinstance(error, ImportError):
                raise damaged_image(name, error) from None
            bands, orientation = _decoded_by_pillow(file, stored, page, name), 1
        else:
            # tifffile's axes: (bands stored as planes, depth, height, width, bands stored per
            # pixel). One of the two axes for bands has length 1. The result is (H, W, bands).
            bands = np.moveaxis(array[:, 0], 0, -1).reshape(*array.shape[2:4], -1)
        if raw and photometric in (MIN_IS_BLACK, RGB):
            return bands, orientation
        pixels = _to_pixels(bands, page, name, options, deep)
        mask = _mask_of(stored, page)
        if mask is not None and pixels.shape[2] == 3 and mask.shape == pixels.shape[:2]:
            pixels = on_grey(pixels, mask, 1, name)
        return pixels, orientation


def chosen_page(stored: list[Any], name: str, options: ReadingOptions) -> Any:
    """Return the page that the options choose, or the largest; skip thumbnails and masks."""
    pages = whole_pages(stored)
    if options.page is None:
        return max(pages, key=lambda page: page.imagewidth * page.imagelength)
    if options.page >= len(pages):
        raise ImageError(f"{name} has {len(pages)} pages: give a `page` below that")
    return pages[options.page]


def whole_pages(stored: list[Any]) -> list[Any]:
    """Return the pages, or else their subpages, that are neither thumbnails nor masks."""
    pages = [page for page in stored if not (page.is_reduced or page.is_mask)]
    below = [each for page in stored for each in page.pages or ()] if not pages else []
    return pages or [each for each in below if not (each.is_reduced or each.is_mask)] or stored[:1]


def _mask_of(stored: list[Any], page: Any) -> np.ndarray | None:
    """Return GDAL's mask of a page, (H, W) bool, if one is stored after the page; else None."""
    after = stored[stored.index(page) + 1 :] if page in stored else []
    others = takewhile(lambda each: each.is_mask or each.is_reduced, after)
    size = page.imagewidth, page.imagelength
    masks = (each for each in others if each.is_mask)
    found = next((each for each in masks if (each.imagewidth, each.imagelength) == size), None)
    return None if found is None else np.asarray(found.asarray() != 0)


def page_numbers(source: Any, frames: bool = False) -> list[int]:
    """Return the numbers, from 0, of the images in a file: values of `page` in `load_image`.

    Images at most half as wide or high as the largest do not count: previews, gain maps, and the
    levels of a pyramid. With `frames` (of a video), a stack of channels or slices is an error.
    """
    from tifffile import TiffFile

    with open_file(source) as (file, name):
        if file.read(4) in TIFF_STARTS:
            file.seek(0)
            with TiffFile(file, name="image.tif") as tiff:
                stack = zip(tiff.series[0].axes, tiff.series[0].shape, strict=True)
                axes = {axis: count for axis, count in stack if axis not in "YXS" and count > 1}
                if frames and (len(axes) > 1 or "C" in axes):
                    text = " x ".join(f"{count} ({axis})" for axis, count in axes.items())
                    raise ImageError(
                        f"{name} has {text} images: give those of one channel and slice"
                    )
                sizes = [(each.imagewidth, each.imagelength) for each in whole_pages([*tiff.pages])]
        else:
            with identify(file, name) as image:
                count = 1 if image.format == "PSD" else getattr(image, "n_frames", 1)  # PSD: layers
                sizes = [image.seek(k) or image.size for k in range(count)]
    width, height = np.max(sizes, axis=0)
    return [k for k, (w, h) in enumerate(sizes) if 2 * w > width and 2 * h > height]


def _checked_kind(page: Any, name: str) -> int:
    """Return the photometric interpretation; raise an ImageError if it cannot be read."""
    photometric, count = int(page.photometric), page.samplesperpixel
    known = photometric in (MIN_IS_WHITE, MIN_IS_BLACK, RGB, *MOSAICS)
    known |= photometric == PALETTE and count == 1 and page.colormap is not None
    known |= photometric == CMYK and page.bitspersample == 8 and count == 4
    known |= photometric == YCBCR and page.compression in JPEG
    what = getattr(page.photometric, "name", str(photometric)) + " pixels"
    if page.imagedepth > 1:
        known, what = False, "a volume"
    elif page.dtype is None or page.dtype.kind not in "buif":
        known, what = False, "complex or mixed numbers"
    elif page.nbytes > MAX_BYTES_PER_PIXEL * page.imagewidth * page.imagelength:
        known, what = False, f"{count} bands"
    if not known:
        raise ImageError(f"{name} contains {what}, which cannot be read: convert it to RGB")
    return photometric


def _to_pixels(
    bands: np.ndarray, page: Any, name: str, options: ReadingOptions, deep: bool
) -> np.ndarray:
    """Convert (H, W, bands) values to RGB, or RGB and alpha, as the tags of their page define."""
    photometric = int(page.photometric)
    chosen = _chosen_bands(bands, page, name, options)
    value = no_data_of(page)
    each = np.isnan(chosen) | (chosen == (np.nan if value is None else value))
    absent = each.all(axis=2)  # as in GDAL: a pixel is absent only if all bands are
    empty = each if chosen.dtype.kind == "f" else absent[..., None]
    if empty.any():
        chosen = np.where(empty, chosen.dtype.type(0), chosen)
    if photometric == PALETTE:
        colours = page.colormap if page.colormap.max() < 256 else page.colormap >> 8
        rgb = colours.T.astype(np.uint8)[chosen[:, :, 0].astype(np.intp)]
    elif photometric == CMYK:
        from PIL import Image

        rgb = np.array(Image.fromarray(np.ascontiguousarray(chosen), "CMYK").convert("RGB"))
    else:
        how = {"white": _white(page), "deep": deep, **options.common}
        rgb = array_to_pixels(chosen, name=name, value_range=options.value_range, **how)
    if photometric == MIN_IS_WHITE:
        rgb = ~rgb
    alpha, opaque = ~absent, 1
    extra = [each in ALPHA for each in page.extrasamples]
    if any(extra):  # the extra samples are the last ones
        alpha = np.where(alpha, bands[:, :, extra.index(True) - len(extra)], 0)
        opaque = 255 if bands.dtype == np.uint8 else max(alpha.max(), 1)
    return on_grey(rgb, alpha, opaque, name, associated=ALPHA[0] in page.extrasamples)


def _chosen_bands(bands: np.ndarray, page: Any, name: str, options: ReadingOptions) -> np.ndarray:
    count, photometric = bands.shape[2], int(page.photometric)
    whole = photometric in (PALETTE, CMYK)
    if options.bands is not None:
        if whole or max(options.bands) > count:
            raise ImageError(f"{name} has {count} bands: leave `bands` out, or choose from them")
        return bands[:, :, np.array(options.bands) - 1]
    grey = photometric in (MIN_IS_WHITE, MIN_IS_BLACK)
    alpha = bool(page.extrasamples) and page.extrasamples[-1] in ALPHA
    if not whole and not (count >= 3 if not grey else count - alpha in (1, 3)):
        raise ImageError(f"{name} has {count} bands: choose three, such as `bands=(3, 2, 1)`")
    return bands if whole else bands[:, :, : count - alpha if grey else 3]


def no_data_of(page: Any) -> float | None:
    """Return the value that means "no data" according to GDAL's tag, or None."""
    try:
        return float(page.tags.valueof(NO_DATA))
    except (TypeError, ValueError):
        return None


def _white(page: Any) -> int | None:
    """Return the value of white if the tags tell it, otherwise None."""
    bits = page.bitspersample
    if page.dtype.kind != "u" or bits > 16 or bits == 8:
        return None
    if bits < 16:
        return (1 << bits) - 1
    values = np.atleast_1d(page.tags.valueof(MAX_SAMPLE_VALUE, 0))
    largest = int(values.max())
    # The tag holds the largest value of a pixel, which is taken for white only if it is 2^n - 1.
    return largest if largest > 255 and not largest & (largest + 1) else None


def _decoded_by_pillow(file: BinaryIO, stored: list[Any], page: Any, name: str) -> np.ndarray:
    """Decode a page by Pillow if Pillow does so correctly and tifffile would need imagecodecs.

    Returns:
        (H, W, bands) as they are stored, but turned upright.
    """
    bits, photometric = page.bitspersample, int(page.photometric)
    grey = photometric == MIN_IS_BLACK and page.samplesperpixel == 1
    plain = page.dtype.kind in ("b", "u") and (bits in (1, 8) or (bits == 16 and grey))
    if plain and page in stored:
        with suppress(ImageError, OSError), identify(file, name) as image:
            image.seek(stored.index(page))
            values = np.asarray(image.convert("RGB") if image.mode == "YCbCr" else image)
            values = values.reshape(*values.shape[:2], -1)
            if photometric == MIN_IS_WHITE:
                values = ~values
            if ALPHA[0] in page.extrasamples:  # Pillow has divided the colours by alpha
                colours = np.rint(values[:, :, :-1] * (values[:, :, -1:] / 255))
                values = np.dstack([colours.astype(np.uint8), values[:, :, -1]])
            if values.shape[2] == page.samplesperpixel:
                return values
    raise MissingExtraError(
        f"{name} has {page.compression.name} compression with {bits} bits per value: run pip "
        "install imagecodecs to read it"
    )
