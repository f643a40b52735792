"""Panoramas and fisheye pictures rendered from a scene of directions, and what looks like them."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
import skimage.data
from PIL import Image
from PIL.ExifTags import IFD, Base
from PIL.PngImagePlugin import PngInfo

from deepdetect import ImageError, load_image
from deepdetect.io.projection import edges_meet, is_round, require_pinhole

HEIGHT = 256
XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description
 xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" {}</rdf:Description></x:xmpmeta>"""


def load_pinhole(image: object, *, rim: bool = False) -> np.ndarray:
    rgb = load_image(image)
    require_pinhole(image, rgb, rim=rim)
    return rgb


def brightness(rays: np.ndarray, seed: int = 0) -> np.ndarray:
    """The scene: a sum of waves over the directions (..., 3), as uint8."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(0, 7, (40, 3))
    total = np.sin(rays @ waves.T + rng.uniform(0, 6, 40)).sum(axis=-1)
    return (128 + 12 * total).clip(20, 255).astype(np.uint8)


def panorama(seed: int = 0, turn: float = 0.0) -> np.ndarray:
    y, x = (np.indices((HEIGHT, 2 * HEIGHT)) + 0.5) * np.pi / HEIGHT
    rays = np.sin(y) * np.cos(x + turn), np.sin(y) * np.sin(x + turn), np.cos(y)
    return brightness(np.stack(rays, axis=-1), seed)


def pinhole(seed: int = 0, size: tuple[int, int] = (2 * HEIGHT, HEIGHT)) -> np.ndarray:
    y, x = np.indices(size[::-1]) - np.array(size[::-1])[:, None, None] / 2
    rays = np.stack([x, y, np.full(x.shape, 200.0)], axis=-1)
    return brightness(rays / np.linalg.norm(rays, axis=-1, keepdims=True), seed)


def fisheye(side: int, degrees: float, size: tuple[int, int]) -> np.ndarray:
    y, x = np.indices(size[::-1]) - (np.array(size[::-1])[:, None, None] - 1) / 2
    radius = np.maximum(np.hypot(x, y), 1e-9)
    angle = radius / (side / 2) * np.radians(degrees / 2)
    rays = np.stack([x / radius * np.sin(angle), y / radius * np.sin(angle), np.cos(angle)], -1)
    return np.where(radius <= side / 2, brightness(rays), 3).astype(np.uint8)


def encoded(gray: np.ndarray, tags: dict | None = None, xmp: str = "", kind: str = "JPEG") -> bytes:
    exif = Image.Exif()
    exif.get_ifd(IFD.Exif).update(tags or {})
    file, notes = io.BytesIO(), PngInfo()
    notes.add_itxt("XML:com.adobe.xmp", xmp)
    kept = {"pnginfo": notes} if kind == "PNG" else {"xmp": xmp.encode()}
    Image.fromarray(gray).convert("RGB").save(file, kind, exif=exif, **kept)
    return file.getvalue()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("turn", [0.0, 1.0, 2.5])
def test_a_full_panorama_continues_over_its_edges(seed: int, turn: float) -> None:
    made = panorama(seed, turn)
    assert edges_meet(made)
    with pytest.raises(ImageError, match="v360=e:flat"):
        load_pinhole(encoded(made))


def test_noise_and_a_black_nadir_hide_no_panorama() -> None:
    noise = np.random.default_rng(0).normal(0, 5, (HEIGHT, 2 * HEIGHT))
    made = (panorama() + noise).clip(0, 255).astype(np.uint8)
    made[-20:] = 0
    assert edges_meet(made)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("quality", "light", "noise"), [(75, 1, 0), (30, 1, 0), (92, 1, 5), (75, 0.2, 1)]
)
def test_neither_compression_nor_noise_nor_darkness_hides_a_panorama(
    seed: int, quality: int, light: float, noise: float
) -> None:
    made = light * panorama(seed) + np.random.default_rng(seed).normal(
        0, noise, (HEIGHT, 2 * HEIGHT)
    )
    file = cv2.imencode(
        ".jpg", made.clip(0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    sphere = cv2.imdecode(file[1], cv2.IMREAD_GRAYSCALE)
    assert edges_meet(sphere)
    assert edges_meet(sphere[56:-56])  # a strip of 100 degrees
    assert not edges_meet(sphere[:, :400][28:-28])


@pytest.mark.parametrize("name", ["rocket", "coffee", "astronaut", "camera", "chelsea", "page"])
def test_photographs_cut_to_2_to_1_are_no_panoramas(name: str) -> None:
    rgb = getattr(skimage.data, name)()
    gray = rgb if rgb.ndim == 2 else cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    height = min(len(gray), gray.shape[1] // 2)
    assert not edges_meet(gray[:height])
    assert not edges_meet(gray[-height // 2 :])
    mirrored = np.hstack([gray[:height, ::-1], gray[:height]])  # so are its edges alike
    assert not edges_meet(mirrored)


@pytest.mark.parametrize("seed", range(8))
def test_a_photograph_of_2_to_1_is_no_panorama(seed: int) -> None:
    assert not edges_meet(pinhole(seed))


def test_a_panorama_may_be_resized_or_a_cylinder_but_is_wide() -> None:
    made = panorama()
    for size in [(513, 256), (512, 257), (1030, 511)]:
        assert edges_meet(cv2.resize(made, size, interpolation=cv2.INTER_AREA))
    cylinder = made[60:-60]
    with pytest.raises(ImageError, match="photographs"):
        load_pinhole(encoded(cylinder))
    assert not edges_meet(cylinder[:, :-40])
    assert not edges_meet(made[:, 100:-100])


def test_what_repeats_or_is_plain_is_no_panorama() -> None:
    y, x = np.indices((HEIGHT, 2 * HEIGHT)) * 2 * np.pi / HEIGHT
    tile = 128 + 60 * np.sin(3 * x / 2) * np.cos(2 * y) + 50 * np.sin(x + y)
    framed = cv2.copyMakeBorder(pinhole()[8:-8, 8:-8], 8, 8, 8, 8, cv2.BORDER_CONSTANT, value=255)
    studio = np.repeat(np.linspace(90, 220, HEIGHT)[:, None], 2 * HEIGHT, axis=1)
    studio[60:200, 180:330] = pinhole()[60:200, 180:330]
    for made in (tile, framed, studio, np.full((HEIGHT, 2 * HEIGHT), 90.0), np.zeros((16, 32))):
        assert not edges_meet(made.astype(np.uint8))


@pytest.mark.parametrize(
    ("side", "size"), [(240, (240, 240)), (240, (360, 240)), (230, (240, 320))]
)
@pytest.mark.parametrize("degrees", [120, 170])
def test_a_circular_fisheye_is_round(side: int, size: tuple[int, int], degrees: float) -> None:
    made = fisheye(side, degrees, size)
    assert is_round(made)
    with pytest.raises(ImageError, match="v360=fisheye"):
        load_pinhole(encoded(made), rim=True)
    np.testing.assert_array_equal(load_pinhole(made)[..., 0], made)


@pytest.mark.parametrize("ground", [70, 128, 255])
@pytest.mark.parametrize("quality", [75, 92])
def test_a_circle_may_be_on_any_plain_ground(ground: int, quality: int) -> None:
    made = fisheye(236, 170, (320, 240))
    made = np.where(made == 3, ground, made.clip(20, 225)).astype(np.uint8)
    file = cv2.imencode(".jpg", made, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    assert is_round(cv2.imdecode(file, cv2.IMREAD_GRAYSCALE))


def test_objects_on_a_bright_ground_are_not_round() -> None:
    ground = np.full((240, 240), 200, np.uint8)
    plate, shadow = ground.copy(), ground.copy()
    cv2.circle(plate, (120, 120), 100, 60, -1)
    cv2.circle(shadow, (120, 120), 112, 120, -1)
    lit = cv2.GaussianBlur(shadow, (0, 0), 6)  # up to the image edges
    cv2.circle(lit, (120, 120), 105, 240, -1)
    far = np.hypot(*(np.indices((240, 240)) - 120)) / 120
    vignetted = (230 / (1 + 0.4 * far**2) ** 2).astype(np.uint8)  # through a microscope
    square = cv2.copyMakeBorder(ground[5:-5, 5:-5] // 2, 5, 5, 5, 5, cv2.BORDER_CONSTANT, value=255)
    for made in (plate, lit, vignetted, square, skimage.data.coins(), skimage.data.moon()):
        assert not is_round(made)


@pytest.mark.parametrize("ground", [0, 30])
@pytest.mark.parametrize("diameter", [280, 330, 420])
def test_a_circle_may_be_cut_and_on_a_dark_ground(diameter: int, ground: int) -> None:
    made = fisheye(diameter, 170, (426, 240))
    made = np.where(made > 3, made.clip(ground + 20), ground).astype(np.uint8)
    assert is_round(made)
    assert not is_round(made[:, 115:-115])  # cut on all sides: a lens hood looks the same


@pytest.mark.parametrize("size", [(240, 240), (320, 240), (213, 240)])
def test_two_fisheye_pictures_side_by_side(size: tuple[int, int]) -> None:
    one = fisheye(min(size) - 4, 170, size)
    with pytest.raises(ImageError, match="dfisheye"):
        load_pinhole(encoded(np.hstack([one, one])), rim=True)
    load_pinhole(encoded(np.hstack([one, pinhole(1, size)])), rim=True)


@pytest.mark.parametrize("turned", [False, True])
def test_a_cross_of_six_squares_is_a_cube_map(turned: bool) -> None:
    cross = pinhole(0, (256, 192))
    cross[:64, [*range(64), *range(128, 256)]] = 0
    load_pinhole(encoded(cross))
    cross[128:, [*range(64), *range(128, 256)]] = 0
    with pytest.raises(ImageError, match="faces"):
        load_pinhole(encoded(cross.T if turned else cross))


def test_other_pictures_on_black_are_not_round() -> None:
    vignetted = fisheye(290, 120, (240, 240))  # a lens hood cuts the corners
    small = fisheye(150, 120, (240, 240))  # a ball on black
    framed = cv2.copyMakeBorder(pinhole(0, (200, 200)), 20, 20, 20, 20, cv2.BORDER_CONSTANT)
    for made in (vignetted, small, framed, np.zeros((240, 240), np.uint8), pinhole()):
        assert not is_round(made)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
@pytest.mark.parametrize(
    ("xmp", "word"),
    [
        ('GPano:ProjectionType="equirectangular">', "photographs"),
        ("><GPano:ProjectionType>equirectangular</GPano:ProjectionType>", "photographs"),
        ('GPano:ProjectionType="cylindrical">', "photographs"),
    ],
)
def test_a_part_of_a_panorama_says_so_in_its_metadata(kind: str, xmp: str, word: str) -> None:
    made = pinhole(0, (300, 200))
    with pytest.raises(ImageError, match=word):
        load_pinhole(encoded(made, xmp=XMP.format(xmp), kind=kind))
    load_pinhole(encoded(made, xmp=XMP.format('GPano:ProjectionType="rectilinear">'), kind=kind))


def test_a_full_panorama_by_its_metadata_need_not_look_like_one(tmp_path: Path) -> None:
    path = tmp_path / "sphere.jpg"
    path.write_bytes(encoded(pinhole(), xmp=XMP.format('GPano:ProjectionType="equirectangular">')))
    with pytest.raises(ImageError, match=r"sphere\.jpg .*v360=e:flat"):
        load_pinhole(path)


@pytest.mark.parametrize(
    "tags",
    [
        {Base.CustomRendered: 6},
        {Base.LensModel: "EF8-15mm f/4L FISHEYE USM"},
        {Base.LensMake: "Samyang", Base.LensModel: "8mm f/3.5 Fish-Eye CS"},
    ],
)
def test_exif_tells_panoramas_of_phones_and_fisheye_lenses(tags: dict) -> None:
    with pytest.raises(ImageError):
        load_pinhole(encoded(pinhole(0, (300, 200)), tags))


def test_other_lenses_are_read_as_before() -> None:
    tags = {Base.CustomRendered: 1, Base.LensModel: "EF24-70mm f/2.8L II USM"}
    data = encoded(pinhole(0, (300, 200)), tags)
    assert load_pinhole(data, rim=True).shape == (200, 300, 3)
