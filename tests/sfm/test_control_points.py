"""Files of ground control points as surveyors write them, against pyproj."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

from deepdetect import OptionError
from deepdetect.sfm.control_points import ControlRow, read_control_points

US_FOOT = 1200 / 3937
FOOT = 0.3048


def read(path: Path, system: str, *lines: str) -> list[ControlRow]:
    pytest.importorskip("pyproj", reason="needs pyproj")
    path = path / "gcp_list.txt"
    path.write_text("\n".join([system, *lines]), encoding="utf-8")
    return read_control_points(path)


@pytest.mark.parametrize(
    ("system", "x", "y", "unit"),
    [
        ("EPSG:2249", 774000, 2956000, US_FOOT),
        ("EPSG:2249+6360", 774000, 2956000, US_FOOT),
        ("EPSG:2249+5703", 774000, 2956000, 1),
        ("EPSG:2249+8228", 774000, 2956000, FOOT),
        ("EPSG:2222", 700000, 900000, FOOT),  # Arizona, international feet
        ("EPSG:26986+6360", 236000, 901000, US_FOOT),
        ("EPSG:32633", 500000, 5400000, 1),
        ("EPSG:32633+5831", 500000, 5400000, -1),  # depths
        ("EPSG:4326", 15.0, 48.7, 1),
        ("EPSG:4326+6360", -71.0, 42.3, US_FOOT),
        ("EPSG:4979", 15.0, 48.7, 1),
        ("WGS84 UTM 33N", 500000, 5400000, 1),
        ("wgs84 utm 33n", 500000, 5400000, 1),
        (
            "+proj=utm +zone=33 +datum=WGS84 +units=us-ft",
            500000 / US_FOOT,
            5400000 / US_FOOT,
            US_FOOT,
        ),
        ("'+proj=utm +zone=33 +datum=WGS84 +units=m +vunits=ft'", 500000, 5400000, FOOT),
        ("EPSG:2193", 1600000, 5400000, 1),  # the axes of New Zealand: north, then east
    ],
)
def test_units_are_those_of_the_system(
    system: str, x: float, y: float, unit: float, tmp_path: Path
) -> None:
    pyproj = pytest.importorskip("pyproj", reason="needs pyproj")
    (row,) = read(tmp_path, system, f"{x} {y} 164.042 100.5 200 a.jpg p0")
    source = "EPSG:32633" if "utm 33" in system.lower() else system.strip("'")
    longitude, latitude = pyproj.Transformer.from_crs(
        source.split("+")[0] or source, 4326, always_xy=True
    ).transform(x, y)
    assert row.place == pytest.approx((latitude, longitude, unit * 164.042), abs=1e-8)
    assert (row.name, row.image, *row.xy) == ("p0", "a.jpg", 100.5, 200)
    assert ("ellipsoid" in row.heights) == (system == "EPSG:4979" or "+vunits" in system)


@pytest.mark.parametrize(
    "system",
    ["EPSG:4978", "EPSG:5703", 'LOCAL_CS["grid",UNIT["metre",1]]', "EPSG:1", "nowhere", ""],
)
def test_systems_without_a_place_are_refused(system: str, tmp_path: Path) -> None:
    with pytest.raises(OptionError):
        read(tmp_path, system, "774000 2956000 164.042 100 200 a.jpg p0")


USUAL = ("500100", "5400200", "12.5", "100.5", "200", "DJI 1.JPG", "north wall")


@pytest.mark.parametrize(
    "lines",
    [
        ["\t".join(USUAL)],
        [" ".join(f'"{word}"' for word in USUAL)],
        [" ".join(USUAL)],
        ["  ".join(USUAL).replace(" wall", " 'wall'")],
        [", ".join(USUAL)],
        [";".join(USUAL) + ";"],
        ["\t".join(USUAL[:5]) + "\t" + '"DJI 1.JPG"\tnorth wall'],
        ["# made by hand", "", "   # and checked", " ".join(USUAL)],
        ["geo_x geo_y geo_z im_x im_y image_name gcp_name", " ".join(USUAL)],
        ["# Easting,Northing,Height,Pixel X,Pixel Y,File Name,Label", ",".join(USUAL)],
        [
            "label\timage\tpx\tpy\ty\tx\tz",
            "north wall\tDJI 1.JPG\t100.5\t200\t5400200\t500100\t12.5",
        ],
        [
            "name,image,accuracy,column,row,x,y,z",
            "north wall,DJI 1.JPG,0.02,100.5,200,500100,5400200,12.5",
        ],
        ["image x y z col row name", "DJI 1.JPG 500100 5400200 12.5 100.5 200 north wall"],
    ],
)
def test_columns_and_names_as_they_are_written(lines: list[str], tmp_path: Path) -> None:
    (row,) = read(tmp_path, "EPSG:32633", *lines)
    (expected,) = read(tmp_path, "EPSG:32633", "500100 5400200 12.5 100.5 200 a.jpg")
    assert (row.name, row.image) == ("north wall", "DJI 1.JPG")
    assert row.place == expected.place
    np.testing.assert_array_equal(row.xy, [100.5, 200])
    assert expected.name == "500100 5400200 12.5"


@pytest.mark.parametrize(
    "line",
    [
        "p0 500100 5400200 12.5 100.5 200 a.jpg",
        "a.jpg 500100 5400200 12.5 100.5 200",
        "500100 5400200 12.5 100.5 200",
        "500100\t5400200\t\t100.5\t200\ta.jpg\tp0",
        "500100 5400200 inf 100.5 200 a.jpg",
        "500100 5400200 12.5 nan 200 a.jpg",
        "1e300 5400200 12.5 100 200 a.jpg",
        "500100,5 5400200,5 12,5 100 200 a.jpg",
    ],
)
def test_other_lines_are_refused(line: str, tmp_path: Path) -> None:
    with pytest.raises(OptionError):
        read(tmp_path, "EPSG:32633", line)


@pytest.mark.parametrize("separator", [",", ";"])
def test_tables_as_spreadsheets_write_them(separator: str, tmp_path: Path) -> None:
    """They fill up short lines, and end lines as DOS does."""
    lines = ["EPSG:32633" + 6 * separator, separator.join(USUAL), ""]
    path = tmp_path / "gcp.csv"
    path.write_bytes("\r\n".join(lines).encode())
    (row,) = read_control_points(path)
    assert (row.name, row.image, row.place[2]) == ("north wall", "DJI 1.JPG", 12.5)
    path.write_bytes("\n".join(lines).replace("wall", "W\u00e4nde").encode("latin-1"))
    with pytest.raises(OptionError, match="UTF-8"):
        read_control_points(path)


def test_degrees_in_the_wrong_order_and_unknown_heights(tmp_path: Path) -> None:
    (row,) = read(tmp_path, "EPSG:4326", "lat lon alt px py image", "48.7 15 nan 1 2 a.jpg")
    assert row.place[:2] == pytest.approx((48.7, 15))
    assert np.isnan(row.place[2])
    with pytest.raises(OptionError):
        read(tmp_path, "EPSG:4326", "48.7 115 3 1 2 a.jpg")


@pytest.mark.parametrize(
    ("system", "x", "y"),
    [
        ("EPSG:32633", 5400200, 500100),  # exchanged
        ("EPSG:2249", 236000, 901000),  # metres in place of feet
        ("EPSG:27700", 5400200, 500100),
    ],
)
def test_places_far_from_those_of_the_system_are_told(
    system: str, x: float, y: float, tmp_path: Path
) -> None:
    with pytest.warns(UserWarning, match="far"):
        read(tmp_path, system, f"{x} {y} 3 1 2 a.jpg")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read(tmp_path, "EPSG:32633", "150000 5400200 3 1 2 a.jpg")  # zone 32 would be nearer
