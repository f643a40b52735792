"""Photographs of the fountain with fixes at their known places, and all that is written of them."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import GPS, IFD

from deepdetect import MissingExtraError, OptionError, PointDetector, reconstruct_many
from deepdetect.datasets.posed_images import load_posed_scenes
from deepdetect.sfm import MultiViewOptions, MultiViewReconstruction
from deepdetect.sfm.formats import FORMATS
from deepdetect.sfm.georeference import Georeference

from ..io.test_gps import place_tags

NAMES = ("0003", "0004", "0005", "0006")
METRES_PER_DEGREE = np.array([111_132.95, 78_846.8])
"""Of latitude and longitude, at 45 degrees north, by WGS 84."""


@pytest.fixture(scope="module")
def centres(shared: Path) -> np.ndarray:
    """Where the cameras are, in metres."""
    (scene,) = load_posed_scenes(shared / "data" / "fountain")
    poses = {image.path.stem: image for image in scene.images}
    return np.array([-poses[name].rotation.T @ poses[name].translation for name in NAMES])


@pytest.fixture(scope="module")
def placed(
    write_fountain, centres: np.ndarray, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, MultiViewReconstruction]:
    """The folder of a model in all formats, and the model."""
    for package in ("h5py", "pycolmap", "laspy", "lazrs", "pyproj"):
        pytest.importorskip(package, reason=f"needs {package}")
    root = tmp_path_factory.mktemp("placed")
    folder = write_fountain(root / "photos", NAMES, 288)
    for name, (east, north, up) in zip(NAMES, centres, strict=True):
        path = folder / f"{name}.jpg"
        with Image.open(path) as image:
            exif = image.getexif()
            latitude, longitude = [45, 9] + np.array([north, east]) / METRES_PER_DEGREE
            exif.get_ifd(IFD.GPSInfo).update(place_tags(latitude, longitude, up + 100))
            exif.get_ifd(IFD.GPSInfo)[GPS.GPSHPositioningError] = 0.02
            image.save(path, quality=95, exif=exif)
    options = MultiViewOptions(stride_px=4, formats=tuple(FORMATS))
    detector = PointDetector(1000)
    return root / "model", reconstruct_many(
        folder, root / "model", detector, options=options, workers=1
    )


def test_the_model_is_in_metres_at_its_place(placed, centres: np.ndarray) -> None:
    output, found = placed
    assert isinstance(found.georeference, Georeference)
    assert set(found.views) == {f"{name}.jpg" for name in NAMES}
    distances = np.linalg.norm(np.diff(found.centres, axis=0), axis=1)
    np.testing.assert_allclose(
        distances, np.linalg.norm(np.diff(centres, axis=0), axis=1), rtol=0.03
    )
    direction, true = (points[-1] - points[0] for points in (found.centres, centres))
    assert direction / np.linalg.norm(direction) @ true > 0.999 * np.linalg.norm(true)
    values = json.loads((output / "model.json").read_text())
    assert values["georeference"]["origin"]["latitude"] == pytest.approx(45, abs=1e-3)
    assert set(values["georeference"]["residuals_m"]) == set(found.views)
    assert values["cameras"]["0004.jpg"]["centre"] == found.views["0004.jpg"].centre.tolist()
    assert found.cloud.unit == "m"
    assert b"frame: x east, y north, z up" in (output / "model.ply").read_bytes()[:600]
    assert {path.name for path in output.iterdir()} == {
        *(path.name for path in found.files),
        "work",
    }


def test_dense_points_lie_where_the_sparse_ones_do(placed) -> None:
    _, found = placed
    for view in found.views.values():
        xy, depth = view.project(found.dense.points)
        _, own = view.project(found.sparse.points)
        assert np.median(depth) == pytest.approx(np.median(own), rel=0.3)
        assert ((xy > 0) & (xy < view.camera.size)).all(axis=1).mean() > 0.5


def test_laz_is_read_by_laspy(placed) -> None:
    import laspy

    output, found = placed
    las = laspy.read(output / "model.laz")
    assert las.header.parse_crs().to_epsg() == 32632
    assert found.georeference.origin is not None
    utm, _ = found.georeference.origin.to_utm(found.dense.points)
    np.testing.assert_allclose(las.xyz, utm, atol=1e-3)
    np.testing.assert_array_equal(np.asarray(las.blue) // 257, found.dense.colors[:, 2])


def test_maps_are_read_by_rasterio(placed) -> None:
    rasterio = pytest.importorskip("rasterio", reason="needs rasterio")
    output, found = placed
    utm, _ = found.georeference.origin.to_utm(found.dense.points)
    with (
        rasterio.open(output / "height.tif") as heights,
        rasterio.open(output / "orthophoto.tif") as photo,
    ):
        assert heights.crs.to_epsg() == photo.crs.to_epsg() == 32632
        assert heights.transform == photo.transform
        assert heights.transform.e == -heights.transform.a  # north is up
        sampled = np.array([value[0] for value in heights.sample(utm[:, :2])])
        colors = np.array([*photo.sample(utm[:, :2])])
    # Of the few points outside the map there is no height; the others are near their own.
    known = np.isfinite(sampled)
    assert known.mean() > 0.9
    assert np.median(np.abs(sampled - utm[:, 2])[known]) < np.ptp(utm[known, 2]) / 4
    assert (colors[known].sum(axis=1) > 0).mean() > 0.99


def test_formats_are_checked_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pycolmap
) -> None:
    for formats in (("laz", "shp"), ("lazz",)):
        with pytest.raises(OptionError, match="unknown format"):
            reconstruct_many(tmp_path, tmp_path / "m", options=MultiViewOptions(formats=formats))
    find = importlib.util.find_spec
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name: None if name == "laspy" else find(name)
    )
    with pytest.raises(MissingExtraError, match="laspy"):
        reconstruct_many(tmp_path, tmp_path / "m", options=MultiViewOptions(formats=("laz",)))
