"""Made cameras on a known path: photographs with fixes, control points, distances."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL.ExifTags import GPS

from deepdetect import (
    Camera,
    OptionError,
    PointDetector,
    ReconstructionError,
    reconstruct_many,
)
from deepdetect._shared.errors import NoPlaceError
from deepdetect.geometry.camera import PosedView
from deepdetect.geometry.similarity import Similarity
from deepdetect.io.gps import read_gps
from deepdetect.sfm import MultiViewOptions
from deepdetect.sfm.colmap import CameraIntrinsics
from deepdetect.sfm.control_points import read_control_points
from deepdetect.sfm.georeference import Georeference, Origin, georeference, upright
from deepdetect.sfm.mapping import RegisteredImage, SparseModel

from ..io.test_gps import place_tags, write_photograph

ORIGIN = Origin(47.5, 8.25, 430.0)
CAMERA = Camera((640, 480), 600.0)
NORTH_LEVEL = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""From east, north, up to the camera of a photograph that looks north, held level."""


def turn(axis: str, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return {
        "z": np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
        "x": np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
    }[axis]


def made_model(
    centres: np.ndarray, rotations: list[np.ndarray], points: np.ndarray, model: Similarity
) -> SparseModel:
    """Put cameras and points in metres east, north, up into the frame of a mapping.

    `model` goes from that frame to metres.
    """

    def inside(xyz: np.ndarray) -> np.ndarray:
        return (xyz - model.translation) @ model.rotation / model.scale

    images = {}
    for k, (centre, rotation) in enumerate(zip(inside(centres), rotations, strict=True)):
        own = rotation @ model.rotation
        view = PosedView(f"{k:02}.jpg", CAMERA, own, -own @ centre)
        xy, _ = view.project(inside(points))
        rows = np.arange(len(points))
        intrinsics = CameraIntrinsics.of_camera(CAMERA)
        images[view.name] = RegisteredImage(view, intrinsics, rows, xy)
    zeros = np.zeros(len(points))
    return SparseModel(images, inside(points), zeros, zeros, zeros.astype(int))


@pytest.fixture
def hidden() -> Similarity:
    rotation = turn("z", 110) @ turn("x", 70) @ turn("z", 20)
    return Similarity(6.5, rotation, np.array([30.0, -12.0, 4.0]))


def write_fixes(folder: Path, enu: np.ndarray, xmp: list[str] | None = None) -> None:
    pyproj = pytest.importorskip("pyproj", reason="needs pyproj")
    system = f"+proj=topocentric +ellps=WGS84 +lat_0={ORIGIN.latitude} +lon_0={ORIGIN.longitude}"
    pipeline = f"+proj=pipeline +step +inv {system} +h_0={ORIGIN.height} +step +inv +proj=cart"
    longitude, latitude, height = pyproj.Transformer.from_pipeline(pipeline).transform(*enu.T)
    for k, place in enumerate(zip(latitude, longitude, height, strict=True)):
        write_photograph(folder / f"{k:02}.jpg", place_tags(*place), xmp[k] if xmp else "")


def heading_error_deg(found: Similarity, true: Similarity) -> float:
    """Return the angle about the vertical between two results."""
    between = found.rotation @ true.rotation.T
    return float(abs(np.degrees(np.arctan2(between[1, 0], between[0, 0]))))


def tilt_error_deg(found: Similarity, true: Similarity) -> float:
    between = found.rotation @ true.rotation.T
    return float(np.degrees(np.arccos(np.clip(between[2, 2], -1, 1))))


@pytest.mark.parametrize("seed", range(3))
def test_noisy_fixes_two_of_them_wrong(
    pycolmap, tmp_path: Path, hidden: Similarity, seed: int
) -> None:
    """Photographs of a walk of some 300 m: 3 m of noise, two fixes 200 m off."""
    random = np.random.default_rng(seed)
    at = np.linspace(0, 5, 40)
    centres = np.column_stack([45 * at, 60 * np.sin(at), 0.5 * np.cos(2 * at)])
    rotations = [
        turn("z", random.normal(0, 2)) @ NORTH_LEVEL @ turn("z", -heading)
        for heading in np.degrees(at)
    ]
    fixes = centres + random.normal(0, 3, (40, 3))
    fixes[[7, 25]] += [[200.0, 0, 0], [-140.0, 143.0, 0]]
    write_fixes(tmp_path, fixes)
    sparse = made_model(centres, rotations, np.zeros((1, 3)), hidden)
    found = georeference(sparse, sparse.points, tmp_path)
    assert isinstance(found, Georeference)
    assert found.similarity.scale == pytest.approx(hidden.scale, rel=0.02)
    assert heading_error_deg(found.similarity, hidden) < 2
    assert tilt_error_deg(found.similarity, hidden) < 2
    assert found.wrong == ("07.jpg", "25.jpg")
    values = json.loads(json.dumps(found.summary()))
    assert values["used"] == 38
    assert values["utm_crs"] == "EPSG:32632"
    assert 2 < values["median_residual_across_m"] < 5
    assert np.linalg.norm(values["residuals_m"]["07.jpg"]) == pytest.approx(200, abs=12)


@pytest.mark.parametrize("kind", ["level", "gimbal"])
def test_along_a_line_the_cameras_know_up(
    pycolmap, tmp_path: Path, hidden: Similarity, kind: str
) -> None:
    """Photographs along a street, or of a drone above it that looks down at 60 degrees."""
    random = np.random.default_rng(1)
    centres = np.column_stack([np.linspace(0, 120, 20), np.zeros(20), np.full(20, 2.0)])
    down = 60 if kind == "gimbal" else 0
    rotations = [turn("z", random.normal(0, 2)) @ turn("x", down) @ NORTH_LEVEL for _ in centres]
    gimbal = 'drone-dji:GimbalPitchDegree="-60.0" drone-dji:GimbalRollDegree="0.0"'
    xmp = [f"<a {gimbal}/>"] * 20 if kind == "gimbal" else None
    write_fixes(tmp_path, centres + random.normal(0, 1.5, centres.shape), xmp)
    sparse = made_model(centres, rotations, np.zeros((1, 3)), hidden)
    found = georeference(sparse, sparse.points, tmp_path)
    assert isinstance(found, Georeference)
    assert found.similarity.scale == pytest.approx(hidden.scale, rel=0.02)
    assert heading_error_deg(found.similarity, hidden) < 2
    assert tilt_error_deg(found.similarity, hidden) < 3
    assert "line" in found.summary()["note"]


def test_a_drone_that_looks_straight_down_needs_no_gimbal(
    pycolmap, tmp_path: Path, hidden: Similarity
) -> None:
    """A grid of photographs, all with the same heading: their columns are no up."""
    random = np.random.default_rng(2)
    x, y = np.meshgrid(np.arange(6) * 20.0, np.arange(5) * 25.0)
    centres = np.column_stack([x.ravel(), y.ravel(), np.full(30, 80.0)])
    rotations = [turn("x", 90) @ NORTH_LEVEL for _ in centres]
    write_fixes(tmp_path, centres + random.normal(0, 1.5, centres.shape))
    sparse = made_model(centres, rotations, np.zeros((1, 3)), hidden)
    found = georeference(sparse, sparse.points, tmp_path)
    assert isinstance(found, Georeference)
    assert found.similarity.scale == pytest.approx(hidden.scale, rel=0.02)
    assert heading_error_deg(found.similarity, hidden) < 2
    assert tilt_error_deg(found.similarity, hidden) < 2


def test_fixes_that_say_nothing_give_no_place(pycolmap, tmp_path: Path, hidden: Similarity) -> None:
    random = np.random.default_rng(0)
    centres = random.normal(0, 0.5, (10, 3))  # a statue: a metre across, fixes of 3 m
    sparse = made_model(centres, [NORTH_LEVEL] * 10, np.zeros((1, 3)), hidden)
    assert "0 of the images" in str(georeference(sparse, sparse.points, tmp_path))
    write_fixes(tmp_path, random.normal(0, 3, (10, 3)))
    assert "too close together" in str(georeference(sparse, sparse.points, tmp_path))
    write_fixes(tmp_path, np.zeros((10, 3)))
    assert isinstance(georeference(sparse, sparse.points, tmp_path), str)


def test_ground_control_points(pycolmap, tmp_path: Path, hidden: Similarity) -> None:
    """As OpenDroneMap has them, in UTM; one was written down wrong."""
    pyproj = pytest.importorskip("pyproj", reason="needs pyproj")
    random = np.random.default_rng(0)
    centres = np.column_stack([np.arange(6) * 12.0, random.normal(0, 3, 6), np.full(6, 3.0)])
    marks = np.column_stack(
        [random.uniform(0, 60, 6), random.uniform(25, 45, 6), random.uniform(0, 8, 6)]
    )
    sparse = made_model(centres, [NORTH_LEVEL] * 6, marks, hidden)
    utm, epsg = ORIGIN.to_utm(marks)
    # The zone, and what pyproj makes of it, are right.
    longitude, latitude = pyproj.Transformer.from_crs(epsg, 4326, always_xy=True).transform(
        *utm.T[:2]
    )
    np.testing.assert_allclose(
        ORIGIN.to_enu(np.column_stack([latitude, longitude, utm[:, 2]])), marks, atol=1e-3
    )
    utm[5] += [30, 0, 0]
    lines = [
        f"{x:.3f} {y:.3f} {z:.3f} {xy[k, 0]:.2f} {xy[k, 1]:.2f} {name} mark{k}"
        for name, xy in ((name, image.xy) for name, image in sparse.images.items())
        for k, (x, y, z) in enumerate(utm)
    ]
    path = tmp_path / "gcp_list.txt"
    for system in ("WGS84 UTM 32N", "EPSG:32632"):
        path.write_text("\n".join([system, *lines]))
        found = georeference(sparse, sparse.points, tmp_path, read_control_points(path))
        assert isinstance(found, Georeference)
        assert found.wrong == ("mark5",)
        assert found.similarity.scale == pytest.approx(hidden.scale, rel=1e-3)
        assert found.origin is not None
        placed = found.similarity.apply(sparse.points)
        again, _ = found.origin.to_utm(placed)
        np.testing.assert_allclose(again[:5], utm[:5], atol=0.02)
    path.write_text("\n".join(["EPSG:32632", *lines[:3]]))
    with pytest.raises(OptionError):
        georeference(sparse, sparse.points, tmp_path, read_control_points(path))
    path.write_text("nowhere\n1 2 3")
    with pytest.raises(OptionError):
        read_control_points(path)
    path.write_text(
        "\n".join(
            ["EPSG:32632", *(f"{random.uniform(0, 500)} {line.split(' ', 1)[1]}" for line in lines)]
        )
    )
    with pytest.raises(ReconstructionError):
        georeference(sparse, sparse.points, tmp_path, read_control_points(path))


def surveyed(
    hidden: Similarity, relief: float = 8.0
) -> tuple[SparseModel, np.ndarray, np.ndarray, list[tuple[str, int, np.ndarray]]]:
    """Make a model, its control points in metres and in UTM, and the pixels that show them."""
    random = np.random.default_rng(0)
    centres = np.column_stack([np.arange(6) * 12.0, random.normal(0, 3, 6), np.full(6, 3.0)])
    marks = np.column_stack(
        [random.uniform(0, 60, 8), random.uniform(25, 45, 8), random.uniform(0, relief, 8)]
    )
    rotations = [NORTH_LEVEL @ turn("z", heading) for heading in (-40, 25, -10, 35, -30, 15)]
    sparse = made_model(centres, rotations, marks, hidden)
    utm, _ = ORIGIN.to_utm(marks)
    shown = [(n, k, xy) for n, each in sparse.images.items() for k, xy in enumerate(each.xy)]
    return sparse, marks, utm, shown


def survey_file(
    path: Path, system: str, xyz: np.ndarray, shown: list[tuple[str, int, np.ndarray]]
) -> Path:
    rows = [
        "\t".join([*map(repr, xyz[k].tolist()), *map(repr, xy.tolist()), image, f"mark {k}"])
        for image, k, xy in shown
    ]
    path.write_text("\n".join([system, *rows]))
    return path


@pytest.mark.parametrize("relief", [2.0, 30.0])
@pytest.mark.parametrize("mistake", ["feet", "metres", "exchanged", "columns", "names", "none"])
def test_residuals_that_nothing_explains(
    pycolmap, tmp_path: Path, hidden: Similarity, mistake: str, relief: float
) -> None:
    pytest.importorskip("pyproj", reason="needs pyproj")
    sparse, marks, utm, shown = surveyed(hidden, relief=relief)
    sparse = replace(sparse, errors=np.full(len(sparse.errors), 0.6))
    random = np.random.default_rng(1)
    xyz = utm + random.normal(0, 0.03, utm.shape)
    shown = [(n, k, xy + random.normal(0, 0.3, 2)) for n, k, xy in shown]
    if mistake in ("feet", "metres"):
        xyz[:, 2] *= {"feet": 1 / 0.3048, "metres": 0.3048}[mistake]
        xyz[0, 2] = np.nan  # one height is unknown
    elif mistake == "exchanged":
        shift = xyz[:, :2].mean(axis=0)
        xyz[:, :2] = (xyz[:, :2] - shift)[:, ::-1] + shift
    elif mistake == "columns":
        shown = [(n, k, xy[::-1]) for n, k, xy in shown]
    elif mistake == "names":
        xyz = xyz[random.permutation(len(xyz))]
    path = survey_file(tmp_path / "gcp.txt", "EPSG:32632", xyz, shown)
    control = read_control_points(path)
    if mistake != "none":
        with pytest.raises(NoPlaceError, match=mistake if mistake in ("feet", "metres") else None):
            georeference(sparse, sparse.points, tmp_path, control)
        return
    found = georeference(sparse, sparse.points, tmp_path, control)
    assert isinstance(found, Georeference)
    np.testing.assert_allclose(
        found.similarity.apply(sparse.points)[0],
        marks[0]
        - (
            ORIGIN.to_enu(
                np.array([[found.origin.latitude, found.origin.longitude, found.origin.height]])
            )[0]
        ),
        atol=0.3,
    )
    assert "WGS 84 / UTM" in found.summary()["origin"]["height_is"]


def test_a_bent_model_is_no_mistake_of_the_points(
    pycolmap, tmp_path: Path, hidden: Similarity
) -> None:
    """Heights in a model of unknown lenses are bent along 60 metres: that is written down."""
    pytest.importorskip("pyproj", reason="needs pyproj")
    sparse, marks, utm, shown = surveyed(hidden)
    bent = utm.copy()
    bent[:, 2] += 2.5 * ((marks[:, 0] - 30) / 30) ** 2
    control = read_control_points(survey_file(tmp_path / "g.txt", "EPSG:32632", bent, shown))
    with pytest.warns(UserWarning, match="bent"):
        found = georeference(sparse, sparse.points, tmp_path, control)
    assert isinstance(found, Georeference)
    assert found.summary()["median_residual_up_m"] > 0.05


@pytest.mark.parametrize("size", [1, 30])
@pytest.mark.parametrize("count", [5, 8])
def test_errors_at_random_are_no_bend_in_a_model_of_any_size(
    pycolmap, size: float, count: int, tmp_path: Path, hidden: Similarity
) -> None:
    """20 metres across models of 60 and of 1800 metres."""
    sparse, marks, _, shown = surveyed(replace(hidden, scale=hidden.scale * size))
    marks = size * marks + np.random.default_rng(count).uniform(-20, 20, marks.shape)
    utm, _ = ORIGIN.to_utm(marks)
    shown = [mark for mark in shown if mark[1] < count]
    control = read_control_points(survey_file(tmp_path / "g.txt", "EPSG:32632", utm, shown))
    with pytest.raises(NoPlaceError):
        georeference(sparse, sparse.points, tmp_path, control)


def test_a_model_across_the_antimeridian(pycolmap, tmp_path: Path, hidden: Similarity) -> None:
    sparse, marks, _, shown = surveyed(hidden)
    places = (marks - np.median(marks, axis=0)) @ np.diag([1 / 106_480, 1 / 110_650, 1])
    places += [180, -17, 10]
    places[:, 0] -= 360 * (places[:, 0] > 180)  # four points of eight
    control = read_control_points(survey_file(tmp_path / "g.txt", "EPSG:4326", places, shown))
    found = georeference(sparse, sparse.points, tmp_path, control)
    assert isinstance(found, Georeference)
    assert found.origin is not None
    assert abs(found.origin.longitude) == pytest.approx(180, abs=0.001)
    assert found.similarity.scale == pytest.approx(hidden.scale, rel=0.01)
    assert tilt_error_deg(found.similarity, hidden) < 1


def test_remarks_behind_names_make_no_further_points(
    pycolmap, tmp_path: Path, hidden: Similarity
) -> None:
    sparse, _, utm, shown = surveyed(hidden)
    path = survey_file(tmp_path / "g.txt", "EPSG:32632", utm, shown)
    lines = path.read_text().splitlines()
    remarked = [f"{line} remark {k}" for k, line in enumerate(lines[1:])]
    path.write_text("\n".join([lines[0], *remarked]))
    found = georeference(sparse, sparse.points, tmp_path, read_control_points(path))
    assert isinstance(found, Georeference)
    assert found.summary()["used"] == len(utm)


@pytest.mark.parametrize("system", ["EPSG:2249", "EPSG:2249+6360", "EPSG:2249+5703", "EPSG:26986"])
def test_a_model_in_feet_is_that_in_metres(
    pycolmap, tmp_path: Path, hidden: Similarity, system: str
) -> None:
    pyproj = pytest.importorskip("pyproj", reason="needs pyproj")
    sparse, _, utm, shown = surveyed(hidden)
    foot = 1200 / 3937
    metres = utm - utm.mean(axis=0) + [236000, 901000, 50]
    to = pyproj.Transformer.from_crs(26986, system.split("+")[0], always_xy=True)
    x, y = to.transform(*metres.T[:2])
    up = metres[:, 2] / (foot if system in ("EPSG:2249", "EPSG:2249+6360") else 1)
    path = survey_file(tmp_path / "g.txt", system, np.column_stack([x, y, up]), shown)
    found = georeference(sparse, sparse.points, tmp_path, read_control_points(path))
    assert isinstance(found, Georeference)
    assert found.origin is not None
    assert found.similarity.scale == pytest.approx(hidden.scale, rel=1e-3)
    assert found.origin.height == pytest.approx(50, abs=5)
    assert found.summary()["median_residual_across_m"] < 0.01


def test_one_name_of_two_places_is_refused(pycolmap, tmp_path: Path, hidden: Similarity) -> None:
    pytest.importorskip("pyproj", reason="needs pyproj")
    sparse, _, utm, shown = surveyed(hidden)
    path = survey_file(tmp_path / "g.txt", "EPSG:32632", utm, shown)
    path.write_text(path.read_text().replace("mark 3", "mark 4"))
    with pytest.raises(NoPlaceError, match="mark 4"):
        georeference(sparse, sparse.points, tmp_path, read_control_points(path))


DJI = 'drone-dji:{}="{}"'


@pytest.mark.parametrize(
    ("kinds", "height", "expected"),
    [
        (["relative"] * 8, 80, "take-off"),
        (["absolute relative"] * 8, 430, "sea level"),
        (["relative"] * 3 + ["absolute relative"] * 5, 80, "take-off"),
        (["relative"] * 3 + ["absolute"] * 5, 430, "sea level"),
        (["rtk relative"] * 5 + ["exif"] * 3, 430, "ellipsoid"),
        (["exif relative"] * 8, 430, "sea level"),
        (["below"] * 8, -430, "sea level"),
        (["relative"] * 7 + ["none"], None, "unknown"),
    ],
)
def test_heights_of_one_kind_and_what_they_are(
    pycolmap,
    kinds: list[str],
    height: float | None,
    expected: str,
    tmp_path: Path,
    hidden: Similarity,
) -> None:
    random = np.random.default_rng(0)
    centres = np.column_stack([random.uniform(0, 300, (8, 2)), np.full(8, 80.0)])
    sparse = made_model(centres, [turn("x", 90) @ NORTH_LEVEL] * 8, np.zeros((1, 3)), hidden)
    write_fixes(tmp_path, centres)
    for k, kind in enumerate(kinds):
        path = tmp_path / f"{k:02}.jpg"
        fix = read_gps(path)
        assert fix is not None
        altitude = {"exif": 430.0, "below": -430.0}.get(kind.split()[0])
        words = []
        if "relative" in kind:
            words.append(DJI.format("RelativeAltitude", "+80.0"))
        if "absolute" in kind or "rtk" in kind:
            words.append(DJI.format("AbsoluteAltitude", "+430.0"))
        if "rtk" in kind:
            words.append(DJI.format("RtkFlag", "50"))
        write_photograph(
            path, place_tags(fix.latitude, fix.longitude, altitude), f"<a {' '.join(words)}/>"
        )
    found = georeference(sparse, sparse.points, tmp_path)
    assert isinstance(found, Georeference)
    origin = found.summary()["origin"]
    assert expected in origin["height_is"]
    assert origin["height"] == pytest.approx(0 if height is None else height)
    assert (origin["crs"] == "EPSG:4979") == (expected == "ellipsoid")


def test_missing_hemispheres_are_told_once(pycolmap, tmp_path: Path, hidden: Similarity) -> None:
    random = np.random.default_rng(0)
    centres = np.column_stack([random.uniform(0, 300, (6, 2)), np.full(6, 80.0)])
    sparse = made_model(centres, [NORTH_LEVEL] * 6, np.zeros((1, 3)), hidden)
    write_fixes(tmp_path, centres)
    for k in range(6):
        path = tmp_path / f"{k:02}.jpg"
        fix = read_gps(path)
        assert fix is not None
        tags = place_tags(fix.latitude, fix.longitude, fix.altitude)
        del tags[GPS.GPSLatitudeRef]
        write_photograph(path, tags)
    with pytest.warns(UserWarning, match="north") as told:
        found = georeference(sparse, sparse.points, tmp_path)
    assert len(told) == 1
    assert isinstance(found, Georeference)


@pytest.mark.parametrize("seed", range(4))
def test_control_points_along_a_line(
    pycolmap, tmp_path: Path, hidden: Similarity, seed: int
) -> None:
    """On a kerb of 100 m: the cameras know up."""
    pytest.importorskip("pyproj", reason="needs pyproj")
    random = np.random.default_rng(seed)
    centres = np.column_stack([np.arange(6) * 15.0, random.normal(0, 3, 6), np.full(6, 3.0)])
    marks = np.column_stack(
        [np.linspace(0, 100, 5), 30 + random.normal(0, 0.1, 5), random.normal(0, 0.1, 5)]
    )
    rotations = [NORTH_LEVEL @ turn("z", heading) for heading in (-40, 25, -10, 35, -30, 15)]
    sparse = made_model(centres, rotations, marks, hidden)
    utm, epsg = ORIGIN.to_utm(marks + random.normal(0, 0.05, marks.shape))
    lines = [
        f"{x:.3f} {y:.3f} {z:.3f} {xy[0]:.2f} {xy[1]:.2f} {name} mark{k}"
        for name, image in sparse.images.items()
        for k, ((x, y, z), xy) in enumerate(zip(utm, image.xy, strict=True))
    ]
    path = tmp_path / "gcp_list.txt"
    path.write_text("\n".join([f"EPSG:{epsg}", *lines]))
    found = georeference(sparse, sparse.points, tmp_path, read_control_points(path))
    assert isinstance(found, Georeference)
    assert tilt_error_deg(found.similarity, hidden) < 3
    assert heading_error_deg(found.similarity, hidden) < 1
    assert "line" in found.summary()["note"]


def test_a_known_distance_gives_the_scale(pycolmap, tmp_path: Path, hidden: Similarity) -> None:
    centres = np.column_stack([np.arange(4) * 2.0, np.zeros((4, 2))])
    points = np.array([[0.0, 10, 0], [3, 10, 1], [3.1, 30, 1]])
    sparse = made_model(centres, [NORTH_LEVEL] * 4, points, hidden)
    xy = sparse.images["01.jpg"].xy.round(1)
    pixels = [f"01.jpg:{x},{y}" for x, y in xy.tolist()]
    for distance, *ends in ((4.0, "00.jpg", "02.jpg"), (np.sqrt(10), pixels[0], pixels[1])):
        found = georeference(sparse, sparse.points, tmp_path, scale_by=(distance, *ends))
        assert isinstance(found, Georeference)
        assert found.similarity.scale == pytest.approx(hidden.scale, rel=1e-6)
        assert found.origin is None
        np.testing.assert_array_equal(found.similarity.rotation, np.eye(3))
    for ends in (("00.jpg", "00.jpg"), ("00.jpg", "no.jpg"), ("00.jpg:0,0", "00.jpg")):
        with pytest.raises(OptionError):
            georeference(sparse, sparse.points, tmp_path, scale_by=(1.0, *ends))
    # With fixes, too, it is this distance that holds.
    write_fixes(tmp_path, 1.3 * centres * 20)
    placed = georeference(sparse, sparse.points, tmp_path, scale_by=(80.0, "00.jpg", "02.jpg"))
    assert isinstance(placed, Georeference)
    assert placed.similarity.scale == pytest.approx(20 * hidden.scale, rel=1e-6)


@pytest.mark.slow
def test_photographs_of_a_street_with_a_phones_fixes(
    shared: Path, tmp_path: Path, pycolmap
) -> None:
    """Fifteen, taken upright along a street; their fixes are some metres off, and on a line."""
    folder = shared / "data" / "lund"
    if not folder.is_dir():
        pytest.skip("needs the photographs of Lund in ../shared")
    options = MultiViewOptions(dense=False)
    found = reconstruct_many(folder, tmp_path / "m", PointDetector(3000), options=options)
    place = found.georeference
    assert isinstance(place, Georeference)
    assert len(place.residuals) == len(found.views) >= 14
    values = place.summary()
    assert values["median_residual_across_m"] < 6
    assert values["scale_std_percent"] < 10
    assert values["least_certain_axis_std_deg_by_these_alone"] > 45
    fixes = found.centres + [place.residuals[name] for name in found.views]
    headings = []
    for path in (found.centres, fixes):
        east, north, _ = np.polyfit(np.arange(len(path)), path, 1)[0]
        headings.append(np.degrees(np.arctan2(east, north)))
    assert abs(headings[0] - headings[1]) < 5
    downs = np.array([view.rotation[1] for view in found.views.values()])
    tilts = np.degrees(np.arccos(np.clip(-downs[:, 2], -1, 1)))
    assert np.median(tilts) < 5


def test_what_is_upright() -> None:
    views = {
        str(k): PosedView(str(k), CAMERA, NORTH_LEVEL @ turn("z", 50 * k), np.zeros(3))
        for k in range(5)
    }
    up, level, stds = upright(views).values()
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-3)
    np.testing.assert_allclose(level @ [0, 0, 1], 0, atol=1e-9)
    assert len(stds) == len(level) == 10


def test_a_whole_name_is_that_of_its_image_alone(pycolmap, hidden: Similarity) -> None:
    centres = np.column_stack([[0, 2.0, 10], np.zeros((3, 2))])
    sparse = made_model(centres, [NORTH_LEVEL] * 3, np.array([[0.0, 10, 0]]), hidden)
    named = dict(zip(("x.jpg", "y.jpg", "z/x.jpg"), sparse.images.values(), strict=True))
    sparse = replace(sparse, images=named)
    found = georeference(sparse, sparse.points, Path("."), scale_by=(2.0, "x.jpg", "y.jpg"))
    assert isinstance(found, Georeference)
    assert found.similarity.scale == pytest.approx(hidden.scale, rel=1e-6)
    named["w/y.jpg"] = named["y.jpg"]
    del named["y.jpg"]
    named["z/y.jpg"] = named["x.jpg"]
    with pytest.raises(OptionError):  # of two images of this name
        georeference(sparse, sparse.points, Path("."), scale_by=(2.0, "x.jpg", "y.jpg"))


def test_heights_are_measured_where_they_are_known(
    pycolmap, tmp_path: Path, hidden: Similarity
) -> None:
    at = np.linspace(0, 5, 12)
    centres = np.column_stack([45 * at, 60 * np.sin(at), 3 * np.cos(2 * at)])
    sparse = made_model(centres, [NORTH_LEVEL] * 12, np.zeros((1, 3)), hidden)
    write_fixes(tmp_path, centres)
    found = georeference(sparse, sparse.points, tmp_path)
    assert isinstance(found, Georeference)
    found.residuals["03.jpg"][2] = np.nan
    assert found.summary()["median_residual_up_m"] == pytest.approx(0, abs=0.01)
