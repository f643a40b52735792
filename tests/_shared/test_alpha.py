"""Transparent pixels are grey, hold no keypoints, and are drawn over nothing."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from deepdetect import PointDetector, load_image, match_images, register, stitch
from deepdetect.cli import main
from deepdetect.io.image import load_visible

HIDDEN = np.zeros((160, 200), bool)
HIDDEN[:60, 120:] = True


@pytest.fixture
def scene() -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 256, (220, 300, 3)).astype(np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 40, 255, cv2.NORM_MINMAX)


def content(image: Image.Image, kind: str = "PNG", **options: Any) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


def alpha_of(hidden: np.ndarray) -> np.ndarray:
    return np.where(hidden, 0, 255).astype(np.uint8)


def cut_outs(rgb: np.ndarray) -> dict[str, Any]:
    rgba, grey = np.dstack([rgb, alpha_of(HIDDEN)]), cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    palette = Image.fromarray(rgb).quantize(250)
    palette.putpalette([*(palette.getpalette() or [])[:750], *[0] * 18])
    palette.frombytes(np.where(HIDDEN, 255, np.asarray(palette)).astype(np.uint8).tobytes())
    key = np.where(HIDDEN[..., None], (1, 2, 3), rgb).astype(np.uint8)
    grey16 = np.where(HIDDEN, 7, grey.astype(np.uint16) * 257).astype(np.uint16)
    _, rgba16 = cv2.imencode(".png", cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA).astype("u2") * 257)
    return {
        "RGBA": content(Image.fromarray(rgba)),
        "LA": content(Image.fromarray(np.dstack([grey, alpha_of(HIDDEN)]))),
        "WebP": content(Image.fromarray(rgba), "WEBP", lossless=True, exact=True),
        "TIFF": content(Image.fromarray(rgba), "TIFF"),
        "palette": content(palette, transparency=255),
        "GIF": content(palette, "GIF", transparency=255),
        "colour key": content(Image.fromarray(key), transparency=(1, 2, 3)),
        "16 bits": bytes(rgba16),
        "grey key of 16 bits": content(Image.fromarray(grey16), transparency=7),
        "array": rgba,
        "planes": rgba.transpose(2, 0, 1),
        "floats": (rgba / 255).astype(np.float32),
    }


KINDS = [*cut_outs(np.zeros((160, 200, 3), np.uint8))]


@pytest.mark.parametrize("kind", KINDS)
def test_transparent_pixels_are_grey_and_told(kind: str, scene: np.ndarray) -> None:
    image = cut_outs(scene[:160, :200])[kind]
    rgb, hidden = load_visible(image)
    assert hidden is not None
    np.testing.assert_array_equal(hidden, HIDDEN)
    assert (rgb[HIDDEN] == 128).all()
    np.testing.assert_array_equal(load_image(image), rgb)
    found = PointDetector(500).detect(image)
    columns, rows = np.rint(found.xy).astype(int).T
    assert len(found) > 50
    assert not HIDDEN[rows, columns].any()


def test_an_alpha_that_tells_nothing(scene: np.ndarray) -> None:
    opaque = np.dstack([scene, np.full(scene.shape[:2], 255, np.uint8)])
    np.testing.assert_array_equal(load_image(opaque), scene)
    assert load_visible(opaque)[1] is None
    with pytest.warns(UserWarning, match="transparent"):
        found = load_image(np.dstack([scene, np.zeros(scene.shape[:2], np.uint8)]))
    np.testing.assert_array_equal(found, scene)


@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
@pytest.mark.parametrize("how", ["inside", "beside", "planes", "value 0", "nan"])
def test_masks_and_no_data_of_gdal(how: str, scene: np.ndarray, tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    grey = scene[:160, :200, 0].copy()
    values = np.where(HIDDEN, np.nan, grey / 255).astype("f4") if how == "nan" else grey
    if how == "value 0":
        values[HIDDEN] = 0
    count = 3 if how == "planes" else 1
    kind = {"driver": "GTiff", "width": 200, "height": 160, "count": count, "dtype": values.dtype}
    kind |= {"nodata": 0} if how == "value 0" else {}
    kind |= {"interleave": "band", "photometric": "RGB"} if how == "planes" else {}
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=how != "beside"),
        rasterio.open(tmp_path / "a.tif", "w", **kind) as file,
    ):
        file.write(np.stack([values] * count))
        if how in ("inside", "beside", "planes"):
            file.write_mask(alpha_of(HIDDEN))
    rgb, hidden = load_visible(tmp_path / "a.tif")
    np.testing.assert_array_equal(hidden, HIDDEN)
    np.testing.assert_array_equal(rgb[~HIDDEN, 0], grey[~HIDDEN])


def test_matches_do_not_end_at_transparent_pixels(scene: np.ndarray) -> None:
    first, second = scene[:160, :200], scene[20:180, 30:230]
    for number in (0, 1):
        pair = [first, second]
        pair[number] = np.dstack([pair[number], alpha_of(HIDDEN)])
        found = match_images(pair[0], pair[1], PointDetector(2000), model="homography")
        columns, rows = np.rint((found.points0, found.points1)[number]).astype(int).T
        assert len(found) > 50
        assert not HIDDEN[rows, columns].any()
        np.testing.assert_allclose(np.median(found.points0 - found.points1, 0), [30, 20], atol=1)


def test_a_panorama_does_not_show_transparent_pixels(scene: np.ndarray) -> None:
    first = scene[:160, :200]
    second = np.dstack([scene[20:180, 60:260], alpha_of(HIDDEN[:, ::-1])])
    second[..., :3][HIDDEN[:, ::-1]] = 0
    for images in ((first, second), (second, first)):
        found = stitch(images, PointDetector(2000), reference=0)
        assert (found.image[found.valid].max(axis=1) > 30).all()
        assert not found.valid.all()


def test_a_panorama_keeps_the_numbers_of_its_images(scene: np.ndarray) -> None:
    grey = (scene[..., 0].astype(np.uint16) - 40) * 19  # 12 bits
    first, second = grey[:160, :200].copy(), grey[:160, 80:280].copy()
    first[0, 0] = 65535
    found = stitch([first, second], PointDetector(2000), reference=0)
    differences = np.abs(found.image[5:155, 5:195, 0].astype(int) - first[5:155, 5:195])
    assert np.median(differences) < 20


@pytest.mark.parametrize("dtype", ["i2", "f4", "u2"])
def test_rasters_are_stitched_in_their_own_type(
    dtype: str, scene: np.ndarray, tmp_path: Path
) -> None:
    tifffile = pytest.importorskip("tifffile")
    grey = (scene[..., 0] * 0.5 - (0 if dtype == "u2" else 100)).astype(dtype)
    grey[:10, :20] = -99 if dtype != "u2" else 999
    no_data = [(42113, "s", 0, str(grey[0, 0]), True)]
    paths = [tmp_path / "a.tif", tmp_path / "b.tif"]
    for path, part in zip(paths, (grey[:160, :200], grey[:160, 80:280]), strict=True):
        tifffile.imwrite(path, part, extratags=no_data)
    options = ["--value-range", "-100", "30"] if dtype != "u2" else ["--value-range", "0", "200"]
    output = tmp_path / "c.tif"
    run = ["stitch", *paths, "-o", output, "--reference", paths[0], *options]
    assert main([*map(str, run), "--detector", "points"]) == 0
    found = tifffile.imread(output)
    assert found.dtype == dtype
    assert found.ndim == 2
    assert found[4, 4] == grey[0, 0]
    assert np.median(np.abs(found[15:155, 30:195] - grey[15:155, 30:195].astype(float))) < 1


def test_registered_images_keep_their_numbers_and_holes(scene: np.ndarray) -> None:
    grey = (scene[..., 0].astype(np.uint16) - 40) * 19  # 12 bits
    first, second = grey[:160, :200], grey[10:170, 20:220].copy()
    second[0, 0] = 65535
    found = register(first, second, PointDetector(2000))
    inner = cv2.erode(found.valid.astype(np.uint8), np.ones((9, 9))) > 0
    assert np.abs(found.warped[inner, 0].astype(int) - first[inner]).mean() < 30
    assert np.median(found.difference()[inner]) <= 2
    cut = np.dstack([scene[10:170, 20:220], alpha_of(HIDDEN)])
    found = register(scene[:160, :200], cut, PointDetector(2000))
    assert not found.valid[20:60, 150:].any()
    assert not found.warped[~found.valid].any()
    assert np.median(found.difference()[found.valid]) <= 2
