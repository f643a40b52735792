"""Read ground control points: surveyed places, and the pixels that show them."""

from __future__ import annotations

import csv
import re
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .._shared.errors import OptionError, first_line, require_packages
from ..io.gps import ELLIPSOID
from ..io.image_file import IMAGE_SUFFIXES

COLUMNS = {
    "x": "x geox east easting lon longitude",
    "y": "y geoy north northing lat latitude",
    "z": "z geoz up height elevation altitude alt",
    "column": "column col px pixelx imx imagex u",
    "row": "row py pixely imy imagey v",
    "image": "image imagename imname filename file photo",
    "name": "name gcp gcpname gcpid id label point pointname marker",
}
"""Columns of a file of control points in their default order; the last one, `name`, may be missing.
Each value lists the header words for its column, in lower case and without punctuation."""


class ControlRow(NamedTuple):
    """A ground control point at pixel `xy` of an image; `place` is latitude, longitude, height.

    The height is in metres, NaN if unknown. `heights` says what the height is measured from.
    """

    name: str
    place: tuple[float, float, float]
    image: str
    xy: np.ndarray
    heights: str = "unknown"


def read_control_points(path: str | Path) -> list[ControlRow]:
    """Read a file of ground control points in the format of OpenDroneMap.

    The first line names the coordinate system, such as "EPSG:32633", "EPSG:2249+6360" or "WGS84 UTM
    33N". Each other line is `x y z column row image [name]`: a point's coordinates, x to the east,
    and its pixel in an image, separated by blanks, tabs, commas or semicolons. A header may state
    another order. The unit of heights is that of the system's vertical axis; if there is none, that
    of x and y, or metres if x and y are degrees.
    """
    require_packages("a file of ground control points", "pyproj")
    try:
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
        return _parsed(line.strip() for line in lines if line.strip())
    except (OSError, UnicodeError) as error:
        why = f"({first_line(error)}): check the path, and save the file as text in UTF-8"
        raise OptionError(f"{path} cannot be read {why}") from None
    except Exception as error:  # an error of pyproj, or text in place of numbers
        raise OptionError(
            f"{path} is not a file of ground control points ({first_line(error)}): the first line "
            "must be the coordinate system, such as EPSG:32633, and each other line 'x y z column "
            "row image' with x to the east, unless a header states another order"
        ) from None


def _parsed(lines: Iterable[str]) -> list[ControlRow]:
    from pyproj import CRS, Transformer

    column_of = {word: column for column, words in COLUMNS.items() for word in words.split()}
    system, order, rows = "", [*COLUMNS], []
    for line in lines:
        words = _words(line.lstrip("# "))
        named = [column_of.get(re.sub(r"[\W_]", "", word.lower()), word) for word in words]
        if {*[*COLUMNS][:-1]} <= {*named}:
            order = named
        elif system and line[0] != "#":
            rows.append(_in_order(words, order))
        elif line[0] != "#":
            system = line.rstrip(",;").strip("'\"")
    if zone := re.fullmatch(r"WGS84 UTM (\d+)([NS]?)", system.upper()):
        system = f"EPSG:{(32700 if zone[2] == 'S' else 32600) + int(zone[1])}"
    crs = CRS.from_user_input(system)
    if not (crs.is_projected or crs.is_geographic):
        raise ValueError(f"{system} has neither eastings and northings nor degrees")
    x, y, z, *xy = np.array([row[:5] for row in rows], np.float64).reshape(-1, 5).T
    flat = Transformer.from_crs(crs.to_2d(), 4326, always_xy=True)
    longitude, latitude = flat.transform(x, y)
    known = np.isfinite([longitude, *xy]).all() and (abs(latitude) <= 90).all()
    if not (len(rows) and known and all(row[5] for row in rows)) or np.isinf(z).any():
        raise ValueError(f"there are no points, or one lies outside {system} or has no image")
    # Zones are used beyond their borders, so points may lie outside by a zone's own size.
    if area := crs.area_of_use:
        width = (area.east - area.west) % 360 or 360
        aside = np.median((longitude - area.west + width) % 360)
        above = abs(2 * np.median(latitude) - area.north - area.south)
        if aside > 3 * width or above > 3 * (area.north - area.south):
            text = f"the ground control points are far from where {crs.name} is used: check the "
            text += "coordinate system, the unit, and the order of the columns"
            warnings.warn(text, UserWarning, stacklevel=2)
    across, _, *up = crs.axis_info
    unit = (up or [across])[0].unit_conversion_factor if up or crs.is_projected else 1.0
    z = -unit * z if up and up[0].direction == "down" else unit * z
    ellipsoidal = up and up[0].name == "Ellipsoidal height"
    heights = ELLIPSOID if ellipsoidal else f"as in the ground control points ({crs.name})"
    places = zip(latitude.tolist(), longitude.tolist(), z.tolist(), strict=True)
    return [
        ControlRow(row[6] or " ".join(row[:3]), place, row[5], pixel, heights)
        for row, place, pixel in zip(rows, places, np.transpose(xy), strict=True)
    ]


def _words(line: str) -> list[str]:
    for separator in "\t;,":
        row = next(csv.reader([line.rstrip(separator)], delimiter=separator, skipinitialspace=True))
        if len(row) >= len(COLUMNS) - 1 and all(row):
            return [word.strip() for word in row]
    return ["".join(word) for word in re.findall(r"\"([^\"]*)\"|'([^']*)'|(\S+)", line)]


def _in_order(words: list[str], order: list[str]) -> list[str]:
    """Sort a line's words by `COLUMNS`. Only the last column and image names may hold blanks."""
    at, last = order.index("image"), len(order) - 1
    ends = (k for k in range(at, len(words)) if words[k].lower().endswith(IMAGE_SUFFIXES))
    end = next(ends, at) + 1
    words = [*words[:at], " ".join(words[at:end]), *words[end:]]
    if len(words) < last:
        raise ValueError(f"a line has fewer than {last} columns")
    fields = dict(zip(order, [*words[:last], " ".join(words[last:])], strict=True))
    return [fields.get(column, "") for column in COLUMNS]
