"""Fixes written by hand, as phones and drones have them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

from deepdetect.io.gps import read_gps
from deepdetect.io.picture_file import Metadata

XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description
 xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {}/></x:xmpmeta>"""


def write_photograph(path: Path, tags: dict, xmp: str = "", orientation: int = 1) -> Path:
    exif = Image.Exif()
    exif[Base.Orientation] = orientation
    exif.get_ifd(IFD.GPSInfo).update(tags)
    if path.suffix == ".tif":  # Pillow would write no place
        Metadata(exif=exif).write_tiff(np.zeros((24, 32, 3), np.uint8), path)
    else:
        Image.new("RGB", (32, 24)).save(path, exif=exif, xmp=xmp.encode())
    return path


def place_tags(latitude: float, longitude: float, altitude: float | None = None) -> dict:
    def parts(degrees: float) -> tuple[float, float, float]:
        whole = int(abs(degrees))
        return float(whole), 0.0, (abs(degrees) - whole) * 3600

    tags = {
        GPS.GPSLatitudeRef: "N" if latitude >= 0 else "S",
        GPS.GPSLatitude: parts(latitude),
        GPS.GPSLongitudeRef: "E" if longitude >= 0 else "W",
        GPS.GPSLongitude: parts(longitude),
    }
    if altitude is not None:
        tags |= {
            GPS.GPSAltitudeRef: b"\x01" if altitude < 0 else b"\x00",
            GPS.GPSAltitude: abs(altitude),
        }
    return tags


@pytest.mark.parametrize("name", ["a.jpg", "a.tif", "a.png"])
@pytest.mark.parametrize("place", [(55.6985, 13.1954, 37.0), (-33.9, -70.6, -4.5)])
def test_a_fix_of_exif(tmp_path: Path, name: str, place: tuple[float, float, float]) -> None:
    fix = read_gps(write_photograph(tmp_path / name, place_tags(*place)))
    assert fix is not None
    assert (fix.latitude, fix.longitude, fix.altitude) == pytest.approx(place, abs=1e-6)
    assert fix.gravity is None
    assert fix.accuracy_m is None


def test_a_phone_tells_its_accuracy(tmp_path: Path) -> None:
    tags = place_tags(1, 2) | {GPS.GPSHPositioningError: 4.8}
    fix = read_gps(write_photograph(tmp_path / "a.jpg", tags))
    assert fix is not None
    assert fix.accuracy_m == pytest.approx(4.8)
    assert np.isnan(fix.altitude)


def test_xmp_of_a_drone_is_finer_and_knows_gravity(tmp_path: Path) -> None:
    numbers = {
        "AbsoluteAltitude": "+131.20",
        "RelativeAltitude": "+80.00",
        "GpsLatitude": "+47.1234567",
        "GpsLongtitude": "-122.7654321",
        "GimbalPitchDegree": "-90.00",
        "GimbalRollDegree": "+0.00",
        "RtkStdLat": "0.03",
        "RtkStdLon": "0.04",
    }
    attributes = " ".join(f'drone-dji:{name}="{value}"' for name, value in numbers.items())
    elements = "".join(
        f"<drone-dji:{name}>{value}</drone-dji:{name}>" for name, value in numbers.items()
    )
    for xmp in (XMP.format(attributes), elements):
        fix = read_gps(write_photograph(tmp_path / "a.jpg", place_tags(47.1, -122.7, 0), xmp))
        assert fix is not None
        assert (fix.latitude, fix.longitude, fix.altitude) == (47.1234567, -122.7654321, 131.2)
        assert fix.accuracy_m == pytest.approx(0.05)
        np.testing.assert_allclose(fix.gravity, [0, 0, 1], atol=1e-9)  # it looks straight down
    level = attributes.replace("-90.00", "0.00").replace('RollDegree="+0.00', 'RollDegree="+90.00')
    fix = read_gps(write_photograph(tmp_path / "a.jpg", {}, XMP.format(level)))
    assert fix is not None
    np.testing.assert_allclose(fix.gravity, [1, 0, 0], atol=1e-9)  # its right side is down
    turned = read_gps(write_photograph(tmp_path / "a.jpg", {}, XMP.format(level), 6))
    assert turned is not None
    assert turned.gravity is None


@pytest.mark.parametrize(
    ("north", "east", "expected", "assumed"),
    [
        ("N", "E", (10, 20), False),
        ("s", "West", (-10, -20), False),
        ("South", "e", (-10, 20), False),
        (None, "W", (10, -20), True),
        ("S", None, (-10, 20), True),
        ("", "?", (10, 20), True),
    ],
)
def test_letters_of_hemispheres(
    north: str | None, east: str | None, expected: tuple, assumed: bool, tmp_path: Path
) -> None:
    letters = {GPS.GPSLatitudeRef: north, GPS.GPSLongitudeRef: east}
    tags = place_tags(10, 20) | letters
    fix = read_gps(
        write_photograph(tmp_path / "a.jpg", {k: v for k, v in tags.items() if v is not None})
    )
    assert fix is not None
    assert (fix.latitude, fix.longitude) == expected
    assert fix.assumed_hemisphere == assumed


@pytest.mark.parametrize(("reference", "sign"), [(0, 1), (1, -1), (2, 1), (3, -1), (None, 1)])
def test_what_altitudes_refer_to(reference: int | None, sign: int, tmp_path: Path) -> None:
    tags = place_tags(10, 20, 5.0)
    del tags[GPS.GPSAltitudeRef]
    if reference is not None:
        tags[GPS.GPSAltitudeRef] = bytes([reference])
    fix = read_gps(write_photograph(tmp_path / "a.jpg", tags))
    assert fix is not None
    assert (fix.altitude, fix.reference) == (5 * sign, "above sea level")
    only = XMP.format('drone-dji:RelativeAltitude="+80.0"')
    fix = read_gps(write_photograph(tmp_path / "a.jpg", tags, only))
    assert fix is not None
    assert (fix.altitude, fix.above_take_off) == (5 * sign, 80)


@pytest.mark.parametrize(
    ("version", "reference", "expected"),
    [
        (b"0232", 0, "sea"),
        (b"0300", 0, "ellipsoid"),
        (b"0300", 1, "ellipsoid"),
        (b"0300", 3, "sea"),
    ],
)
def test_heights_of_exif_3(version: bytes, reference: int, expected: str, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif.get_ifd(IFD.Exif)[Base.ExifVersion] = version
    tags = place_tags(10, 20, 5.0) | {GPS.GPSAltitudeRef: bytes([reference])}
    exif.get_ifd(IFD.GPSInfo).update(tags)
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg", exif=exif)
    fix = read_gps(tmp_path / "a.jpg")
    assert fix is not None
    assert expected in fix.reference
    assert fix.altitude == (-5 if reference in (1, 3) else 5)


def test_degrees_without_minutes_or_seconds(tmp_path: Path) -> None:
    tags = place_tags(10, 20) | {GPS.GPSLatitude: (10.5,), GPS.GPSLongitude: (20.0, 15.0)}
    fix = read_gps(write_photograph(tmp_path / "a.jpg", tags))
    assert fix is not None
    assert (fix.latitude, fix.longitude) == (10.5, 20.25)


@pytest.mark.parametrize(
    "tags", [{}, place_tags(0, 0), {GPS.GPSLatitudeRef: "N"}, place_tags(91, 5)]
)
def test_what_is_no_place_is_none(tmp_path: Path, tags: dict) -> None:
    assert read_gps(write_photograph(tmp_path / "a.jpg", tags)) is None
    (tmp_path / "b.jpg").write_bytes(b"no image")
    assert read_gps(tmp_path / "b.jpg") is None
