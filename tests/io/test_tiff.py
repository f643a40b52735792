from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from fuzz.targets.tiff import expected_rgb, tiff_files
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

import deepdetect
from deepdetect import DeepDetectError, load_image
from deepdetect._shared.errors import ImageError, MissingExtraError
from deepdetect.io.tiff import page_numbers

RNG = np.random.default_rng(5)
GREY = RNG.integers(0, 256, (20, 30), dtype=np.uint8)
COLOUR = RNG.integers(0, 256, (20, 30, 3), dtype=np.uint8)
DEEP = RNG.integers(0, 65536, (20, 30, 3), dtype=np.uint16)


def written(array: np.ndarray, **options: Any) -> bytes:
    file = io.BytesIO()
    tifffile.imwrite(file, array, **options)
    return file.getvalue()


def triple(grey: np.ndarray) -> np.ndarray:
    return np.repeat(grey[:, :, None], 3, axis=2)


@pytest.mark.parametrize("compression", [None, "zlib", "lzw", "packbits"])
@pytest.mark.parametrize("tile", [None, (16, 16)])
def test_the_same_pixels_stored_in_any_way_are_the_same_image(
    compression: str | None, tile: tuple[int, int] | None
) -> None:
    how = {"photometric": "rgb", "compression": compression, "tile": tile}
    for colour in (COLOUR, DEEP, DEEP / 65535, (DEEP / 65535).astype(np.float32)):
        planes = np.ascontiguousarray(np.moveaxis(colour, 2, 0))
        for order in "<>":
            whole = written(colour, planarconfig="contig", byteorder=order, **how)
            separate = written(planes, planarconfig="separate", byteorder=order, **how)
            np.testing.assert_array_equal(load_image(whole), load_image(colour))
            np.testing.assert_array_equal(load_image(separate), load_image(colour))
        if compression in ("zlib", "lzw"):
            predicted = written(colour, predictor=True, **how)
            np.testing.assert_array_equal(load_image(predicted), load_image(colour))


@pytest.mark.filterwarnings("ignore:.*`page`")
@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_what_tifffile_writes_is_read_as_it_reads_it(seed: int) -> None:
    content, options = tiff_files(np.random.default_rng(seed))
    try:
        found = load_image(content, **options)
    except DeepDetectError:
        return
    np.testing.assert_array_equal(found, expected_rgb(content, **options))


@pytest.mark.parametrize("bits", [8, 10, 12, 14])
def test_the_bits_of_a_sensor_in_files_of_16(bits: int) -> None:
    ramp = np.tile(np.linspace(0, 2**bits - 1, 30), (20, 1)).round().astype(np.uint16)
    exact = np.rint(ramp / (2**bits - 1) * 255).astype(int)
    for content in (ramp, written(ramp, photometric="minisblack")):
        assert np.abs(load_image(content) - triple(exact)).max() <= 0
        wide = load_image(content, value_range=(0, 65535))
        assert np.abs(wide - triple(ramp / 257)).max() <= 0.5


@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
def test_bits_are_told_by_tags(tmp_path: Path) -> None:
    dark = np.full((20, 30), 700, np.uint16)
    told = written(dark, photometric="minisblack", extratags=[(281, 3, 1, 4095, True)])
    assert load_image(told).max() == round(700 / 4095 * 255)
    rasterio = pytest.importorskip("rasterio")
    kind = {"driver": "GTiff", "width": 30, "height": 20, "count": 1, "dtype": "uint16"}
    with rasterio.open(tmp_path / "packed.tif", "w", nbits=12, **kind) as file:
        file.write(dark + 300, 1)
    assert load_image(tmp_path / "packed.tif").max() == round(1000 / 4095 * 255)


def test_16_bit_colour_png_keeps_the_numbers_of_its_sensor(tmp_path: Path) -> None:
    import cv2

    few = DEEP // 16
    cv2.imwrite(str(tmp_path / "a.png"), few[:, :, ::-1])
    exact = np.rint(few / 4095 * 255)
    np.testing.assert_array_equal(load_image(tmp_path / "a.png"), exact)


def test_ranges_are_given_for_signed_and_large_numbers() -> None:
    for values, low, high in (
        (GREY.astype(np.int16) - 100, -100, 155),
        (GREY.astype(np.uint32) * 1000, 0, 255000),
        (GREY.astype(np.float64) - 7, -7, 248),
    ):
        content = written(values, photometric="minisblack")
        with pytest.raises(ImageError, match="value_range"):
            load_image(content)
        np.testing.assert_array_equal(load_image(content, value_range=(low, high)), triple(GREY))
        np.testing.assert_array_equal(load_image(values, value_range=(low, high)), triple(GREY))


@pytest.mark.parametrize(
    "values",
    [
        (GREY / 2550).astype(np.float32),
        (0.8 + GREY / 2550).astype(np.float16),
        (GREY // 10).astype(np.uint16),
    ],
    ids=["dark floats", "light floats", "16 bits"],
)
def test_numbers_that_use_little_of_their_range_are_told(values: np.ndarray) -> None:
    with pytest.warns(UserWarning, match="`value_range`"):
        load_image(written(values))


@pytest.mark.parametrize("planes", ["contig", "separate"])
def test_bands_are_chosen(planes: str) -> None:
    bands = RNG.integers(0, 256, (7, 20, 30), dtype=np.uint8)
    stored = bands if planes == "separate" else np.moveaxis(bands, 0, 2)
    content = written(stored, photometric="minisblack", planarconfig=planes)
    expected = np.moveaxis(bands[[3, 2, 1]], 0, 2)
    np.testing.assert_array_equal(load_image(content, bands=(4, 3, 2)), expected)
    np.testing.assert_array_equal(load_image(stored, bands=(4, 3, 2)), expected)
    with pytest.raises(ImageError, match="7 bands"):
        load_image(content)
    with pytest.raises(ImageError, match="7 bands"):
        load_image(content, bands=(8, 2, 1))


def test_colours_beside_alpha_and_other_samples() -> None:
    extra = RNG.integers(0, 256, (20, 30, 2), dtype=np.uint8)
    for more, kinds in ((extra[:, :, :1], ["unspecified"]), (extra, ["unspecified"] * 2)):
        content = written(np.dstack([COLOUR, more]), photometric="rgb", extrasamples=kinds)
        np.testing.assert_array_equal(load_image(content), COLOUR)
    for kind, white in (("unassalpha", 200), ("assocalpha", 100)):
        alpha = np.where(np.arange(30) < 9, 0, 255).astype(np.uint8) * np.ones((20, 1), np.uint8)
        alpha[0, 20] = 128
        shade = np.full_like(GREY, 200)
        shade[0, 20] = white  # as stored; both are a little over half of 200 on grey
        grey = written(np.dstack([shade, alpha]), photometric="minisblack", extrasamples=[kind])
        expected = np.where(alpha == 0, 128, 200)
        expected[0, 20] = round(200 * 128 / 255 + 128 * 127 / 255)
        assert np.abs(load_image(grey).astype(int) - triple(expected)).max() <= 1


def test_white_is_zero_and_palettes() -> None:
    np.testing.assert_array_equal(
        load_image(written(GREY, photometric="miniswhite")), triple(~GREY)
    )
    deep = DEEP[:, :, 0]
    inverted = load_image(written(deep, photometric="miniswhite"))
    np.testing.assert_array_equal(inverted, ~load_image(deep))
    colours = RNG.integers(0, 256, (3, 256), dtype=np.uint16)
    for scale in (256, 257):
        content = written(GREY, photometric="palette", colormap=colours * scale)
        np.testing.assert_array_equal(load_image(content), np.moveaxis(colours[:, GREY], 0, 2))


def test_the_full_image_is_read_and_further_pages_by_number() -> None:
    small = GREY[:16, :16].copy()
    file = io.BytesIO()
    with tifffile.TiffWriter(file) as writer:
        writer.write(small, subfiletype=1)
        writer.write(GREY)
        writer.write(~GREY)
        writer.write(GREY[:17, :18].copy())
    content = file.getvalue()
    for page, expected in ((0, GREY), (1, ~GREY), (2, GREY[:17, :18])):
        np.testing.assert_array_equal(load_image(content, page=page), triple(expected))
    with pytest.warns(UserWarning, match="page"):
        np.testing.assert_array_equal(load_image(content), triple(GREY))
    with pytest.raises(ImageError, match="`page`"):
        load_image(content, page=3)
    file = io.BytesIO()
    with tifffile.TiffWriter(file) as writer:
        writer.write(small, subfiletype=1, subifds=1)
        writer.write(GREY, subfiletype=0)
    np.testing.assert_array_equal(load_image(file.getvalue()), triple(GREY))


@pytest.mark.parametrize("kind", ["GIF", "PNG", "WEBP", "MPO"])
def test_pages_of_other_formats(kind: str) -> None:
    frames = [Image.fromarray(GREY), Image.fromarray(~GREY)]
    file = io.BytesIO()
    options = {"lossless": True} if kind == "WEBP" else {"quality": 100} if kind == "MPO" else {}
    frames[0].save(file, kind, save_all=True, append_images=frames[1:], **options)
    with pytest.warns(UserWarning, match="page"):
        first = load_image(file.getvalue())
    for image, expected in ((first, GREY), (load_image(file.getvalue(), page=1), ~GREY)):
        assert np.abs(image - triple(expected).astype(int)).max() <= 2 * (kind == "MPO")
    assert page_numbers(file.getvalue()) == [0, 1]
    with pytest.raises(ImageError, match="2 pages"):
        load_image(file.getvalue(), page=2)


def test_previews_and_pyramids_are_no_pages() -> None:
    half, file = GREY[::2, ::2], io.BytesIO()
    with tifffile.TiffWriter(file) as writer:  # as of a slide scanner, without tags
        for level in (GREY, half, half[::2, ::2]):
            writer.write(level.copy())
    np.testing.assert_array_equal(load_image(file.getvalue()), triple(GREY))  # without a warning
    file = io.BytesIO()  # as of a phone, with a preview
    images = [Image.fromarray(each.copy()) for each in (GREY, half)]
    images[0].save(file, "MPO", save_all=True, append_images=images[1:])
    assert load_image(file.getvalue()).shape[:2] == GREY.shape
    assert page_numbers(file.getvalue()) == [0]


def test_what_is_no_data_is_grey() -> None:
    values = DEEP[:, :, 0] / np.float32(65535)
    values[:4] = -9999
    content = written(values, extratags=[(42113, "s", 0, "-9999", True)])
    found = load_image(content)
    assert (found[:4] == 128).all()
    np.testing.assert_array_equal(found[4:], load_image(values[4:]))
    values[:4] = np.nan
    content = written(values, extratags=[(42113, "s", 0, "nan", True)])
    np.testing.assert_array_equal(load_image(content), found)


def test_the_value_of_no_data_in_one_band_is_a_colour() -> None:
    values = np.maximum(COLOUR, 1)
    values[:4], values[4:8, :, 1] = 0, 0
    found = load_image(written(values, extratags=[(42113, "s", 0, "0", True)]))
    assert (found[:4] == 128).all()
    np.testing.assert_array_equal(found[4:], values[4:])


REFUSED = {
    "CIELab": written(COLOUR, photometric="cielab"),
    "CMYK of 16 bits": written(np.dstack([DEEP, DEEP[:, :, 0]]), photometric="separated"),
    "volume": written(np.stack([GREY] * 16), volumetric=True, tile=(16, 16, 16)),
    "complex": written(GREY.astype(np.complex64), photometric="minisblack"),
    "half": written(DEEP)[: DEEP.nbytes // 2],
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_is_not_read_is_refused_by_name(kind: str) -> None:
    with pytest.raises(ImageError):
        load_image(REFUSED[kind])


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "TIFF"])
def test_truncated_files_are_read_where_that_is_asked_for(kind: str, photo: np.ndarray) -> None:
    file = io.BytesIO()
    Image.fromarray(photo).save(file, kind)
    content = file.getvalue()
    if kind == "TIFF":
        content = written(photo)
    short = content[: len(content) * 9 // 10]
    with pytest.raises(ImageError):
        load_image(short)
    found = load_image(short, allow_truncated=True)
    rows = photo.shape[0] // 2
    assert np.abs(found[:rows].astype(int) - photo[:rows]).mean() < 6
    assert found.shape == photo.shape
    assert load_image(content).shape == photo.shape


def test_without_imagecodecs_pillow_decodes_what_it_decodes_rightly(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fine = [
        written(COLOUR, photometric="rgb", compression="lzw"),
        written(GREY, photometric="miniswhite", compression="lzw"),
        written(DEEP[:, :, 0], photometric="minisblack", compression="lzw"),
        written(GREY, compression="lzw", extratags=[(42113, "s", 0, str(GREY[0, 0]), True)]),
        written(np.dstack([GREY, GREY]), compression="lzw", extrasamples=["unassalpha"]),
    ]
    before = [load_image(content) for content in fine]
    deep = written(DEEP, photometric="rgb", compression="lzw")
    import tifffile._imagecodecs as without

    monkeypatch.setattr(tifffile.tifffile, "imagecodecs", without)
    monkeypatch.setattr(
        tifffile.TIFF, "DECOMPRESSORS", tifffile.tifffile.CompressionCodec(encode=False)
    )
    for content, expected in zip(fine, before, strict=True):
        np.testing.assert_array_equal(load_image(content), expected)
    with pytest.raises(MissingExtraError, match="imagecodecs"):
        load_image(deep)


def test_reading_options_are_checked() -> None:
    for wrong in ({"page": 0.5}, {"bands": (0, 1, 2)}, {"value_range": (0, np.nan)}):
        with pytest.raises(deepdetect.OptionError):
            load_image(written(GREY), **wrong)
