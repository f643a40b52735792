"""GPS position and gravity direction of photographs, from EXIF and from XMP of DJI drones."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL.ExifTags import GPS, IFD, Base

from .exif import number_of, read_tags

XMP_OF_DRONES = re.compile(rb"(?<!/)drone-dji:(\w+)\s*(?:=\s*[\"']([^\"']*)|>([^<]*))")
"""This pattern finds XMP properties of DJI drones, which write them as attributes or elements."""

ELLIPSOID, SEA_LEVEL, TAKE_OFF = "above the ellipsoid", "above sea level", "above take-off"
"""Names of the surfaces from which heights are measured."""

MAX_GRAVITY_TILT_DEG = 120.0
"""Larger gimbal angles, in degrees, are treated as invalid. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class GpsFix:
    """The GPS position of a photograph in WGS 84, and the direction of gravity.

    Attributes:
        latitude, longitude: in degrees, north and east positive.
        altitude: in metres as the camera states it; NaN if unknown.
        accuracy_m: horizontal standard deviation in metres as the camera states it, or None.
        gravity: (3,) unit vector towards the ground in the camera's frame (x right, y down, z
            forward), computed from the gimbal's angles, or None.
        reference: what `altitude` is measured from: `SEA_LEVEL`, or `ELLIPSOID` (RTK, EXIF 3.0).
        above_take_off: metres above the place where a drone took off; NaN if unknown.
        assumed_hemisphere: whether north or east is assumed, because the file states neither.
    """

    latitude: float
    longitude: float
    altitude: float
    accuracy_m: float | None = None
    gravity: np.ndarray | None = None
    reference: str = SEA_LEVEL
    above_take_off: float = np.nan
    assumed_hemisphere: bool = False


def read_gps(path: Path) -> GpsFix | None:
    """Read the GPS position of a photograph; None if it has no valid one.

    XMP is preferred, since drones write it with more digits than EXIF.
    """
    tags, notes = read_tags(path, IFD.GPSInfo)
    xmp = notes.get("xmp") or b""
    found = XMP_OF_DRONES.findall(xmp if isinstance(xmp, bytes) else xmp.encode())
    drone = {name.decode(): number_of(one or other) for name, one, other in found}
    signs = (str(tags.get(tag, "")) for tag in (GPS.GPSLatitudeRef, GPS.GPSLongitudeRef))
    north_south, east_west = (sign.strip().upper()[:1] for sign in signs)
    latitude = _degrees(tags.get(GPS.GPSLatitude), north_south == "S")
    longitude = _degrees(tags.get(GPS.GPSLongitude), east_west == "W")
    assumed = north_south not in ("N", "S") or east_west not in ("E", "W")
    # 0: above, 1: below sea level or, since EXIF 3.0, the ellipsoid. 2: above, 3: below sea level.
    reference = tags.get(GPS.GPSAltitudeRef, 0)
    reference = reference[0] if isinstance(reference, bytes) else reference
    altitude = number_of(tags.get(GPS.GPSAltitude)) * (-1 if reference in (1, 3) else 1)
    # Older drones write "Longtitude".
    east = drone.get("GpsLongitude", drone.get("GpsLongtitude", np.nan))
    north, absolute = (drone.get(name, np.nan) for name in ("GpsLatitude", "AbsoluteAltitude"))
    if np.isfinite(east + north) and (north or east):
        latitude, longitude, assumed = north, east, False
    ellipsoidal = number_of(tags.get(Base.ExifVersion)) >= 300 and reference in (0, 1)
    if np.isfinite(absolute):
        altitude, ellipsoidal = absolute, drone.get("RtkFlag", 0) > 0
    if not (abs(latitude) <= 90 and abs(longitude) <= 180) or latitude == longitude == 0:
        return None
    spread = np.hypot(drone.get("RtkStdLat", np.nan), drone.get("RtkStdLon", np.nan))
    accuracy = float(spread) if spread > 0 else number_of(tags.get(GPS.GPSHPositioningError))
    return GpsFix(
        latitude,
        longitude,
        altitude,
        accuracy if accuracy > 0 else None,
        _gravity(drone) if tags.get(Base.Orientation, 1) == 1 else None,
        ELLIPSOID if ellipsoidal else SEA_LEVEL,
        drone.get("RelativeAltitude", np.nan),
        assumed,
    )


def _gravity(drone: dict[str, float]) -> np.ndarray | None:
    """Compute `GpsFix.gravity` from roll and pitch of the gimbal in degrees; pitch -90 is down."""
    angles = [drone.get(f"Gimbal{name}Degree", np.nan) for name in ("Pitch", "Roll")]
    if not max(map(abs, angles)) <= MAX_GRAVITY_TILT_DEG:
        return None
    pitch, roll = np.radians(angles)
    return np.array([np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch), -np.sin(pitch)])


def _degrees(value: Any, below: bool) -> float:
    """Convert degrees, minutes, seconds to degrees: negative if `below` (S, W), NaN if invalid."""
    degrees, minutes, seconds = [*map(number_of, np.ravel(value)), 0.0, 0.0][:3]
    sum_ = degrees + minutes / 60 + (seconds if np.isfinite(seconds) else 0) / 3600
    return -sum_ if below else sum_
