from __future__ import annotations

import importlib.util
import json
import re
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image, ImageCms
from PIL.ExifTags import IFD, Base
from tests.command_line import run_command

from deepdetect import (
    DeepDetectError,
    MissingExtraError,
    OptionError,
    RegistrationError,
    load_image,
    register,
)
from deepdetect.geometry import transform_points
from deepdetect.io.exif import camera_from_exif
from deepdetect.io.image import load_visible
from deepdetect.io.picture_file import Metadata, read_metadata, save_picture

SPACING_M, EAST, NORTH = 0.5, 500_000.0, 5_400_000.0
UTM = 32632


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    """(400, 500, 5) uint16: an ortho-image of five bands."""
    rng = np.random.default_rng(4)
    coarse = rng.integers(0, 4096, (50, 63, 5)).astype(np.float32)
    fine = cv2.resize(coarse, (500, 400), interpolation=cv2.INTER_CUBIC)
    return (fine.clip(0, 4095) * 15).astype(np.uint16)


def geotiff(
    path: Path, bands: np.ndarray, transform: np.ndarray, crs: int = UTM, **tags: Any
) -> None:
    rasterio = pytest.importorskip("rasterio")
    height, width, count = bands.shape
    how = {"driver": "GTiff", "dtype": bands.dtype, "crs": f"EPSG:{crs}"}
    how["transform"] = rasterio.Affine(*transform[:2].ravel())
    with rasterio.open(path, "w", width=width, height=height, count=count, **how, **tags) as file:
        file.write(np.moveaxis(bands, 2, 0))


def place(x: float = 0, y: float = 0, degrees: float = 0) -> np.ndarray:
    """From raster coordinates, of which (x, y) is the first corner, to coordinates."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    north_up = np.array([[SPACING_M, 0, EAST], [0, -SPACING_M, NORTH], [0, 0, 1]])
    return north_up @ np.array([[c, -s, x], [s, c, y], [0, 0, 1]])


@pytest.mark.parametrize("extent", ["reference", "union"])
@pytest.mark.parametrize("turned", [False, True])
def test_a_registered_image_opens_in_its_place(
    extent: str, turned: bool, scene: np.ndarray, tmp_path: Path
) -> None:
    rasterio, pyproj = pytest.importorskip("rasterio"), pytest.importorskip("pyproj")
    matrix = place(degrees=20 if turned else 0)
    geotiff(tmp_path / "ortho.tif", scene[:300, :350, :3], matrix)
    drone = scene[60:360, 120:500].astype(np.int32) - 500
    drone[:8] = -9999
    tifffile.imwrite(
        tmp_path / "drone.tif",
        drone,
        photometric="minisblack",
        planarconfig="contig",
        extratags=[(42113, "s", 0, "-9999", True)],
    )
    heat = (scene[60:360, 120:500, 4] / 65535).astype(np.float32)
    tifffile.imwrite(tmp_path / "heat.tif", heat)
    words = ["register", "ortho.tif", "drone.tif", "--bands", "3", "2", "1", "--extent", extent]
    words += ["--value-range", "0", "61440", "--apply-to", "heat.tif", "--detector", "points"]
    names = [str(tmp_path / word) if word.endswith(".tif") else word for word in words]
    result = run_command([*names, "-o", str(tmp_path / "out"), "--json"])
    assert result.exit_code == 0, result.output
    left, top = json.loads(result.stdout)["origin"]
    assert (left, top) == (0, 0)
    size = {"reference": (350, 300), "union": (500, 360)}[extent]
    east, north, _ = matrix @ [200.5, 150.5, 1]  # the centre of pixel (200, 150) of the ortho-image
    to_degrees = pyproj.Transformer.from_crs(UTM, 4326, always_xy=True)
    with rasterio.open(tmp_path / "out" / "drone_on_ortho.tif") as file:
        assert file.crs.to_epsg() == UTM
        assert (file.width, file.height) == size
        assert (file.count, file.dtypes[0], file.nodata) == (5, "int32", -9999)
        longitude, latitude = to_degrees.transform(east, north)
        back = pyproj.Transformer.from_crs(4326, file.crs, always_xy=True)
        row, column = file.index(*back.transform(longitude, latitude))
        assert (row, column) == (150, 200)
        found = np.moveaxis(file.read(), 0, 2)
    np.testing.assert_allclose(found[150, 200], scene[150, 200].astype(int) - 500, atol=600)
    assert (found[:60] == -9999).all()
    assert (found[64:67, 130:340] == -9999).all()  # rows that the drone has no data of
    inside = found[80:290, 130:340] - (scene[80:290, 130:340].astype(int) - 500)
    assert np.abs(inside).mean() < 400
    with rasterio.open(tmp_path / "out" / "heat_on_ortho.tif") as file:
        assert (file.crs.to_epsg(), file.dtypes) == (UTM, ("float32",))
        assert file.read(1)[150, 200] == pytest.approx(scene[150, 200, 4] / 65535, abs=0.02)


@pytest.mark.filterwarnings("ignore:.*stands still")  # a spot of this noise agrees by chance
def test_a_panorama_lies_where_its_images_do(scene: np.ndarray, tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    rgb = (scene[:, :, :3] >> 8).astype(np.uint8)
    for name, x in (("a", 0), ("b", 150)):
        geotiff(tmp_path / f"{name}.tif", rgb[50:350, x : x + 300], place(x, 50))
    images = [str(tmp_path / f"{name}.tif") for name in "ba"]
    how = ["--detector", "points", "-o"]
    result = run_command(["stitch", *images, *how, str(tmp_path / "p.tif")])
    assert result.exit_code == 0, result.output
    with rasterio.open(tmp_path / "p.tif") as file:
        x, y, _ = place() @ [300.5, 200.5, 1]
        row, column = file.index(x, y)
        assert file.crs.to_epsg() == UTM
        found = file.read()[:, row, column].astype(int)
    np.testing.assert_allclose(found, rgb[200, 300], atol=6)
    assert run_command(["stitch", *images, *how, str(tmp_path / "p.png")]).exit_code == 0
    with rasterio.open(tmp_path / "p.png") as file:
        assert file.index(x, y) == (row, column)
    curved = ["--projection", "cylindrical", *how, str(tmp_path / "c.png")]
    if run_command(["stitch", *images, *curved]).exit_code == 0:
        assert not (tmp_path / "c.pgw").exists()


def test_a_panorama_of_masked_images_is_masked(scene: np.ndarray, tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    rgb = (scene[:, :, :3] >> 8).astype(np.uint8)
    images = [str(tmp_path / f"{name}.tif") for name in "ab"]
    for path, x in zip(images, (0, 150), strict=True):
        geotiff(Path(path), rgb[50:350, x : x + 300], place(x, 50))
        shown = np.full((300, 300), 255, np.uint8)
        shown[: 100 - x // 3] = 0
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "r+") as file:
            file.write_mask(shown)
    how = ["--detector", "points", "--reference", images[0], "-o", str(tmp_path / "p.tif")]
    result = run_command(["stitch", *images, *how])
    assert result.exit_code == 0, result.output
    with rasterio.open(tmp_path / "p.tif") as file:
        found = file.dataset_mask() > 0
        assert file.count == 3
    expected = np.ones((300, 450), bool)
    expected[:50] = expected[50:100, :150] = False
    assert (found == expected).mean() > 0.995
    assert [each.name for each in tmp_path.iterdir() if "msk" in each.name] == []
    assert (load_visible(tmp_path / "p.tif")[1] == ~found).all()


def test_world_files_profiles_and_exif_are_kept(photo: np.ndarray, tmp_path: Path) -> None:
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    exif = Image.Exif()
    exif[Base.Make] = "maker"
    exif[Base.Orientation] = 1
    fine = exif.get_ifd(IFD.Exif)
    fine |= {Base.FocalLengthIn35mmFilm: 28, Base.ExifImageWidth: 256, Base.ExifImageHeight: 256}
    exif.get_ifd(IFD.GPSInfo)[1] = "N"
    Image.fromarray(photo).save(tmp_path / "a.png", exif=exif, icc_profile=profile)
    warp = np.array([[1, 0, -30], [0, 1, 0], [0, 0, 1.0]])
    Image.fromarray(cv2.warpPerspective(photo, warp, (256, 256))).save(tmp_path / "b.png")
    numbers = [0.5, 0.0, 0.0, -0.5, 1000.25, 1999.75]
    (tmp_path / "a.pgw").write_text("\n".join(map(str, numbers)))
    rasterio = pytest.importorskip("rasterio")
    (tmp_path / "a.prj").write_text(rasterio.CRS.from_epsg(UTM).to_wkt())
    for extent, size in (("reference", 256), ("union", 286)):
        out = tmp_path / extent
        words = [str(tmp_path / "a.png"), str(tmp_path / "b.png"), "--extent", extent]
        result = run_command(["register", *words, "-o", str(out)])
        assert result.exit_code == 0, result.output
        with Image.open(out / "b_on_a.png") as written:
            assert written.size[0] == size
            kept = written.getexif()
        assert written.info["icc_profile"] == profile
        assert (kept[Base.Make], kept.get_ifd(IFD.GPSInfo)[1]) == ("maker", "N")
        assert kept.get_ifd(IFD.Exif)[Base.ExifImageWidth] == size
        assert (Base.FocalLengthIn35mmFilm in kept.get_ifd(IFD.Exif)) == (size == 256)
        moved = np.loadtxt(out / "b_on_a.pgw")
        np.testing.assert_allclose(moved, [*numbers[:4], 1000.25, 1999.75])
        projection = (out / "b_on_a.prj").read_text()
        assert rasterio.CRS.from_wkt(projection, morph_from_esri_dialect=True).to_epsg() == UTM
    save_picture(photo, tmp_path / "c.jpg", read_metadata(tmp_path / "a.png"))
    with Image.open(tmp_path / "c.jpg") as written:
        assert written.info["icc_profile"] == profile
    read_metadata(tmp_path / "a.png").write_tiff(photo.astype(np.uint16), tmp_path / "c.tif")
    with tifffile.TiffFile(tmp_path / "c.tif") as file:
        assert file.pages.first.tags["Make"].value == "maker"
        assert file.pages.first.tags["ExifTag"].value["FocalLengthIn35mmFilm"] == 28
    read_metadata(tmp_path / "c.tif").write_tiff(photo, tmp_path / "d.tif")
    for name in ("c.tif", "d.tif"):
        with Image.open(tmp_path / name) as written:
            assert written.getexif().get_ifd(IFD.GPSInfo) == {1: "N"}
            assert written.getexif().get_ifd(IFD.Exif) == fine
        np.testing.assert_array_equal(tifffile.imread(tmp_path / name), photo)
    names = ("a.png", "c.jpg", "d.tif")
    cameras = [camera_from_exif(tmp_path / name, (256, 256)) for name in names]
    assert cameras[0] == cameras[1] == cameras[2]


TURNED_180 = np.diag([-1.0, -1, 1])
NORTHWARD = np.diag([1.0, -1, 1])


@pytest.mark.parametrize("crs", [f"EPSG:{UTM}", None])
@pytest.mark.parametrize("point", [False, True])
@pytest.mark.parametrize("turn", [np.eye(3), NORTHWARD, TURNED_180, None])
def test_corners_of_geotiff_are_those_of_gdal(
    turn: np.ndarray | None, point: bool, crs: str | None, tmp_path: Path
) -> None:
    """Rows may go north, whole coordinates may be centres, and a local grid has no system."""
    rasterio = pytest.importorskip("rasterio")
    bands = np.zeros((20, 30, 1), np.uint8)
    geotiff(tmp_path / "a.tif", bands, place(degrees=20) if turn is None else place() @ turn)
    with rasterio.open(tmp_path / "a.tif", "r+") as file:
        file.crs = crs or rasterio.CRS()
        if point:
            file.update_tags(AREA_OR_POINT="Point")
    with nullcontext() if crs else pytest.warns(UserWarning, match="GeoTIFF"):
        found = read_metadata(tmp_path / "a.tif", placed=True)
    assert found.to_world is not None
    with rasterio.open(tmp_path / "a.tif") as file:
        expected = [file.xy(0, 0), file.xy(7, 11)]
    pixels = np.array([[0, 0], [11, 7.0]])
    np.testing.assert_allclose(transform_points(pixels, found.to_world), expected)
    found.write_tiff(bands, tmp_path / "b.tif")
    with rasterio.open(tmp_path / "b.tif") as file:
        np.testing.assert_allclose([file.xy(0, 0), file.xy(7, 11)], expected)
        assert file.crs == found.crs
    found.write_beside(tmp_path / "b.png")
    Image.new("L", (30, 20)).save(tmp_path / "b.png")
    with rasterio.open(tmp_path / "b.png") as file:
        np.testing.assert_allclose([file.xy(0, 0), file.xy(7, 11)], expected)
    again = read_metadata(tmp_path / "b.png", placed=True)
    np.testing.assert_allclose(transform_points(pixels, again.to_world), expected)
    assert crs is None or again.crs.to_epsg() == found.crs.to_epsg() == UTM


@pytest.mark.parametrize("second_page", [False, True])
def test_a_tie_point_inside_and_a_second_page(second_page: bool, tmp_path: Path) -> None:
    pytest.importorskip("rasterio")
    keys = (1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, UTM)
    tags = [(33550, "d", 3, (0.5, 0.25, 0.0), True), (34735, "H", 16, keys, True)]
    tags.append((33922, "d", 6, (10.0, 5.0, 0.0, EAST, NORTH, 0.0), True))
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        if second_page:
            file.write(np.zeros((16, 16), np.uint8), metadata=None)
        file.write(np.zeros((20, 30), np.uint8), metadata=None, extratags=tags)
    found = read_metadata(tmp_path / "a.tif", placed=True)
    expected = [[0.5, 0, EAST - 5 + 0.25], [0, -0.25, NORTH + 1.25 - 0.125], [0, 0, 1]]
    np.testing.assert_allclose(found.to_world, expected)
    assert found.crs.to_epsg() == UTM


@pytest.mark.parametrize(
    "names",
    [
        *("jpg jgw", "jpg JGW", "jpg Jgw", "JPG jpgw", "jpeg jpegw", "jpeg wld", "jpg WLD"),
        *("png pgw", "PNG PNGw", "tif tfw", "tiff tfw", "tiff TIFFW", "tif Wld", "bmp bpw"),
        *("bmp bmpw", "gif GFW", "jp2 j2w", "ppm wld", "jpg jpg.aux.xml"),
    ],
)
def test_files_of_a_place_of_all_names(names: str, tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    image, world = (tmp_path / f"a.{ending}" for ending in names.split())
    Image.new("RGB", (30, 20)).save(image)
    if world.suffix == ".xml":
        world.write_text(
            "<PAMDataset><GeoTransform>999.9, 0.5, 0.2, 1999.575, 0.1, 0.25</GeoTransform>"
            "</PAMDataset>"
        )
    else:
        world.write_text("0.5\n0.1\n0.2\n0.25\n1000.25\n1999.75\n")
    found = read_metadata(image, placed=True)
    with rasterio.open(image) as file:
        expected = [file.xy(0, 0), file.xy(7, 11)]
    assert found.to_world is not None
    np.testing.assert_allclose(transform_points([[0, 0], [11, 7]], found.to_world), expected)
    np.testing.assert_allclose(expected, [(1000.25, 1999.75), (1007.15, 2002.6)])
    assert found.crs is None


@pytest.mark.parametrize("orientation", range(2, 9))
@pytest.mark.parametrize("name", ["a.jpg", "a.tif"])
def test_a_turned_image_keeps_its_place(orientation: int, name: str, tmp_path: Path) -> None:
    """GDAL places the pixels as they are stored, and `load_image` turns them upright."""
    rasterio = pytest.importorskip("rasterio")
    stored = np.zeros((32, 48, 3), np.uint8)
    stored[8:16, 32:40] = 255
    exif = Image.Exif()
    exif[Base.Orientation] = orientation
    Image.fromarray(stored).save(tmp_path / name, exif=exif)
    (tmp_path / f"a.{name[2]}{name[-1]}w").write_text("0.5\n0.1\n0.2\n-0.5\n1000\n2000\n")
    found = read_metadata(tmp_path / name, placed=True)
    upright = load_image(tmp_path / name)
    y, x = np.argwhere(upright[:, :, 0] > 128).mean(axis=0)
    with rasterio.open(tmp_path / name) as file:
        expected = file.xy(11.5, 35.5)
    np.testing.assert_allclose(transform_points([[x, y]], found.to_world), [expected])


@pytest.mark.parametrize("kind", ["ground control points", "RPC", "webp"])
def test_a_place_that_is_no_matrix_is_told(kind: str, tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    how: dict[str, Any] = {"driver": "GTiff", "width": 30, "height": 20, "count": 1}
    if kind == "RPC":
        line = " ".join(["1"] + ["0"] * 19)
        scale = {f"{name}_{what}": "1" for name in ("LINE", "SAMP") for what in ("OFF", "SCALE")}
        scale |= {
            f"{name}_{w}": "1" for name in ("LAT", "LONG", "HEIGHT") for w in ("OFF", "SCALE")
        }
        terms = {f"{a}_{b}_COEFF": line for a in ("LINE", "SAMP") for b in ("NUM", "DEN")}
        how["rpcs"] = rasterio.rpc.RPC.from_gdal(scale | terms)
    elif kind != "webp":
        how["gcps"] = [
            rasterio.control.GroundControlPoint(row, column, 500 + column, 900 - row, 0)
            for row, column in ((0, 0), (0, 30), (20, 0), (20, 29))
        ]
        how["crs"] = "EPSG:32632"
    path = tmp_path / ("a.webp" if kind == "webp" else "a.tif")
    if kind == "webp":  # GDAL reads no world file of it
        Image.new("RGB", (30, 20)).save(path)
        (tmp_path / "a.wld").write_text("0.5\n0\n0\n-0.5\n1000\n2000\n")
    else:
        gcps = how.pop("gcps", None)
        crs = how.pop("crs", None)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with rasterio.open(path, "w", dtype="uint8", **how) as file:
                if gcps:
                    file.gcps = (gcps, rasterio.CRS.from_user_input(crs))
    with pytest.warns(UserWarning, match="place"):
        assert read_metadata(path, placed=True).to_world is None


@pytest.mark.parametrize("name", ["PAN.JPG", "PAN.PNG", "pan.jpeg"])
def test_a_world_file_has_the_case_of_its_image(name: str, tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    save_picture(np.zeros((20, 30, 3), np.uint8), tmp_path / name)
    Metadata(to_world=np.array([[2.0, 0, 5], [0, -2, 7], [0, 0, 1]])).write_beside(tmp_path / name)
    (world,) = {each.suffix for each in tmp_path.iterdir()} - {Path(name).suffix}
    assert world.isupper() == name.isupper()
    with rasterio.open(tmp_path / name) as file:
        assert file.transform.to_gdal() == (4.0, 2.0, 0.0, 8.0, 0.0, -2.0)


def test_without_rasterio_a_place_is_said_not_lost(
    photo: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    geotiff(tmp_path / "a.tif", photo, place())
    save_picture(photo, tmp_path / "c.jpg")
    (tmp_path / "c.wld").write_text("1 0 0 1 0 0")
    for name, text in (("b", "<Metadata>"), ("d", "<GeoTransform>0, 1, 0, 0, 0, 1")):
        save_picture(photo, tmp_path / f"{name}.png")
        (tmp_path / f"{name}.png.aux.xml").write_text(f"<PAMDataset>{text}")
    find = importlib.util.find_spec
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name: None if name == "rasterio" else find(name)
    )
    np.testing.assert_array_equal(load_image(tmp_path / "a.tif"), photo)
    assert read_metadata(tmp_path / "b.png", placed=True).to_world is None
    for name in ("a.tif", "c.jpg", "d.png"):
        assert read_metadata(tmp_path / name).to_world is None
        words = f"the georeference of {tmp_path / name} needs the package rasterio: run pip"
        with pytest.raises(MissingExtraError, match=re.escape(words)):
            read_metadata(tmp_path / name, placed=True)
        for command in ("register", "stitch"):
            words = [command, str(tmp_path / name), str(tmp_path / "b.png")]
            result = run_command([*words, "-o", str(tmp_path / "out")])
            assert result.exit_code == 2
            assert "run pip install rasterio" in result.stderr
    assert not (tmp_path / "out").exists()


def test_no_union_reaches_the_horizon(photo: np.ndarray) -> None:
    steep = np.array([[0.3, 0, 60], [-0.2, 0.5, 60], [-0.0024, 0, 1.0]])
    second = cv2.warpPerspective(photo, steep, (256, 256), flags=cv2.INTER_AREA)
    try:
        found = register(photo, second, extent="union")
    except RegistrationError:
        return
    assert found.valid.size < 9 * photo[:, :, 0].size


def test_without_anything_there_is_nothing(photo: np.ndarray, tmp_path: Path) -> None:
    save_picture(photo, tmp_path / "a.tif")
    found = read_metadata(tmp_path / "a.tif")
    assert vars(found) == vars(Metadata())
    np.testing.assert_array_equal(load_image(tmp_path / "a.tif"), photo)


SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


@pytest.mark.parametrize(
    "profile",
    [b"no profile", SRGB[:300], *(SRGB[:16] + kind + SRGB[20:] for kind in (b"GRAY", b"CMYK"))],
    ids=["text", "cut off", "grey", "CMYK"],
)
@pytest.mark.parametrize("source", ["a.png", "a.jpg", "a.tif"])
def test_a_profile_that_fits_no_rgb_picture_is_left_out(
    source: str, profile: bytes, photo: np.ndarray, tmp_path: Path
) -> None:
    Image.fromarray(photo).save(tmp_path / source, icc_profile=profile)
    for name in ("b.png", "b.jpg", "b.tif"):
        save_picture(photo, tmp_path / name, read_metadata(tmp_path / source))
        with Image.open(tmp_path / name) as written:
            assert written.info.get("icc_profile") is None
            difference = np.abs(np.asarray(written).astype(int) - photo)
        assert difference.mean() < (6 if name == "b.jpg" else 1e-9)


def test_more_exif_than_a_jpeg_file_holds_does_not_cost_the_picture(
    photo: np.ndarray, tmp_path: Path
) -> None:
    exif = Image.Exif()
    exif[Base.ImageDescription] = "x" * 70_000
    Image.fromarray(photo).save(tmp_path / "a.png", exif=exif)
    metadata = read_metadata(tmp_path / "a.png")
    save_picture(photo, tmp_path / "b.jpg", metadata)
    assert np.abs(load_image(tmp_path / "b.jpg").astype(int) - photo).mean() < 6
    save_picture(photo, tmp_path / "b.png", metadata)
    np.testing.assert_array_equal(load_image(tmp_path / "b.png"), photo)
    with Image.open(tmp_path / "b.png") as written:
        assert written.getexif()[Base.ImageDescription] == "x" * 70_000


@pytest.mark.parametrize("source", ["a.png", "a.jpg", "a.tif"])
def test_texts_that_are_not_ascii_are_kept(source: str, photo: np.ndarray, tmp_path: Path) -> None:
    """Cameras write UTF-8 and Latin-1 where EXIF has ASCII."""
    exif = Image.Exif()
    texts = {Base.Copyright: "© Müller 2024".encode(), Base.Artist: "Jörg Müller".encode("latin-1")}
    exif.update(texts)
    Image.fromarray(photo).save(tmp_path / source, exif=exif)
    for name in ("b.png", "b.jpg", "b.tif"):
        save_picture(photo, tmp_path / name, read_metadata(tmp_path / source))
        with Image.open(tmp_path / name) as written:
            kept = written.getexif()
        for code, text in texts.items():
            assert text in (tmp_path / name).read_bytes()
            assert kept[code].encode("latin-1") == text


def test_exif_that_cannot_be_written_does_not_cost_the_picture(
    photo: np.ndarray, tmp_path: Path
) -> None:
    """Pillow reads larger numbers than it writes, and numbers where texts are due."""
    exif = Image.Exif()
    exif.get_ifd(IFD.Exif)[Base.ExposureTime] = 0.01
    exif[Base.Make] = "Maker"
    Image.fromarray(photo).save(tmp_path / "a.jpg", exif=exif)
    metadata = read_metadata(tmp_path / "a.jpg")
    metadata.exif[Base.Software] = 7
    metadata.exif.get_ifd(IFD.Exif)[Base.FocalLength] = 2**70
    for name in ("b.png", "b.jpg", "b.tif"):
        save_picture(photo, tmp_path / name, metadata)
        assert load_image(tmp_path / name).shape == photo.shape


def test_a_picture_ends_in_png_or_jpg(tmp_path: Path) -> None:
    picture = np.full((20, 30, 3), (200, 30, 90), np.uint8)
    for ending in (".png", ".jpg", ".JPEG"):
        save_picture(picture, tmp_path / f"deep/a{ending}")
        with Image.open(tmp_path / f"deep/a{ending}") as found:
            assert np.abs(np.asarray(found).astype(int) - picture).max() < 8
    with pytest.raises(OptionError, match="must end in"):
        save_picture(picture, tmp_path / "a.bmp")
    assert not (tmp_path / "a.bmp").exists()


def test_a_picture_too_large_for_its_format_is_refused(
    tmp_path: Path, one_line: Callable[[BaseException], str], capfd: pytest.CaptureFixture[str]
) -> None:
    wide = np.zeros((2, 65_501, 3), np.uint8)
    for name in ("p.jpg", "p.JPEG"):
        with pytest.raises(DeepDetectError, match="65501x2 pixels as JPEG: use a name") as error:
            save_picture(wide, tmp_path / name)
        one_line(error.value)
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr().err == ""
    save_picture(wide[:, :-1], tmp_path / "p.jpg")
    save_picture(wide, tmp_path / "p.png")
    with Image.open(tmp_path / "p.png") as picture:
        assert picture.size == (65_501, 2)
