"""Files of places, as GDAL and pyproj read them: georeferenced rasters, ground control points."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from deepdetect.geometry import transform_points
from deepdetect.io.picture_file import read_metadata
from deepdetect.sfm.georeference import read_control_points

from ..case import Target, expect

TYPES = ("uint8", "uint16", "int16", "uint32", "int32", "float32", "float64")
SYSTEMS = (
    *("EPSG:32632", "EPSG:32719", "EPSG:2249", "EPSG:2222", "EPSG:4326", "EPSG:2193", "EPSG:5514"),
    "EPSG:27700",
)
HEIGHTS = {"": None, "+6360": 1200 / 3937, "+8228": 0.3048, "+5703": 1.0, "+5831": -1.0}
"""Vertical systems, and their unit in metres; None: that of x and y."""

WORLD_FILES = {
    "jpg": "jgw jpgw wld",
    "jpeg": "jgw jpegw wld",
    "png": "pgw pngw wld",
    "tif": "tfw tifw wld",
    "tiff": "tfw tiffw wld",
    "bmp": "bpw bmpw wld",
    "gif": "gfw gifw wld",
}


def random_transform(generator: np.random.Generator) -> Any:
    """Return an affine map: north up, rows to the north, turned, sheared, or of unequal pixels."""
    import rasterio

    angle = float(generator.choice([0, 90, 180, 270, generator.uniform(0, 360)]))
    x, y = 10 ** generator.uniform(-3, 2, 2) * generator.choice([-1, 1], 2)
    shift = rasterio.Affine.translation(*generator.uniform(-1e6, 5e6, 2))
    return shift * rasterio.Affine.rotation(angle) * rasterio.Affine.scale(x, y)


def rasters(generator: np.random.Generator, folder: Path) -> None:
    """Read the place of a raster, write it to another file, and ask rasterio for both."""
    import rasterio

    transform, width, height = random_transform(generator), *map(int, generator.integers(2, 40, 2))
    kind = str(generator.choice(["tif", *WORLD_FILES]))
    system = str(generator.choice(SYSTEMS)) if generator.random() < 0.7 else None
    path = folder / f"{generator.choice(['a', 'B c', 'ü'])}.{kind}"
    if kind == "tif" and generator.random() < 0.7:
        dtype, count = str(generator.choice(TYPES)), int(generator.integers(1, 5))
        how = {"driver": "GTiff", "width": width, "height": height, "count": count}
        with rasterio.open(path, "w", dtype=dtype, crs=system, transform=transform, **how) as file:
            file.write(generator.integers(0, 100, (count, height, width)).astype(dtype))
            if generator.random() < 0.3:
                file.update_tags(AREA_OR_POINT="Point")
    else:
        upper = generator.random() < 0.3
        path = path.with_suffix(path.suffix.upper()) if upper else path
        Image.new("RGB", (width, height)).save(path)
        ending = str(generator.choice(WORLD_FILES[kind].split()))
        ending = str(generator.choice([ending, ending.upper(), ending.capitalize()]))
        centre = transform * rasterio.Affine.translation(0.5, 0.5)
        numbers = (centre.a, centre.d, centre.b, centre.e, centre.c, centre.f)
        path.with_suffix(f".{ending}").write_text("".join(f"{each!r}\n" for each in numbers))
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1]])
    found = read_metadata(path, placed=True)
    warnings.simplefilter("ignore")
    with rasterio.open(path) as file:
        placed, crs = not file.transform.is_identity, file.crs
        expected = np.array([file.transform * (x + 0.5, y + 0.5) for x, y in corners])
    expect((found.to_world is not None) == placed, "a place is lost, or made up")
    if found.to_world is None:
        return
    near = 1e-9 * np.abs(expected).max()
    expect(np.allclose(transform_points(corners, found.to_world), expected, 0, near), "elsewhere")
    expect(found.crs == crs, "another coordinate system")
    found.write_tiff(np.zeros((height, width), np.uint8), folder / "out.tif")
    found.write_beside(folder / "out.png")
    Image.new("L", (width, height)).save(folder / "out.png")
    for name in ("out.tif", "out.png"):
        with rasterio.open(folder / name) as file:
            again = np.array([file.transform * (x + 0.5, y + 0.5) for x, y in corners])
        expect(np.allclose(again, expected, 0, near), f"{name} is elsewhere")


def control_points(generator: np.random.Generator, folder: Path) -> None:
    """Read ground control points in any system, order of columns and style of names."""
    from pyproj import CRS, Transformer

    base, height = str(generator.choice(SYSTEMS)), str(generator.choice(list(HEIGHTS)))
    crs = CRS.from_user_input(base)
    unit = HEIGHTS[height]
    if unit is None:
        unit = 1.0 if crs.is_geographic else crs.axis_info[0].unit_conversion_factor
    west, south, east, north = crs.area_of_use.bounds
    count = int(generator.integers(1, 6))
    longitude = west + (east - west) * generator.uniform(0.3, 0.7, count)
    latitude = south + (north - south) * generator.uniform(0.3, 0.7, count)
    x, y = Transformer.from_crs(4326, crs, always_xy=True).transform(longitude, latitude)
    back = Transformer.from_crs(crs, 4326, always_xy=True).transform(x, y)
    z, pixels = generator.uniform(-100, 4000, count), generator.uniform(0, 4000, (count, 2))
    separator = str(generator.choice(["\t", ",", ";", " "]))
    gap = str(generator.choice(["", " "])) if separator != " " else ""
    quote = '"' if generator.random() < 0.4 or separator == " " else ""
    order = list("xyzcrin")
    heads = dict(
        zip(order, ("geo_x", "Northing", "z", "px", "im_y", "image", "label"), strict=True)
    )
    lines = [f"{base}{height}"]
    if generator.random() < 0.5:
        generator.shuffle(order)
        comment = "# " if generator.random() < 0.3 else ""
        lines.append(comment + separator.join(heads[column] for column in order))
    names = [(f"DJI {k}.JPG", f"point {k} \u00e4") for k in range(count)]
    for k, (image, name) in enumerate(names):
        words = {"x": repr(float(x[k])), "y": repr(float(y[k])), "z": repr(float(z[k]))}
        words |= {"c": repr(float(pixels[k, 0])), "r": repr(float(pixels[k, 1]))}
        words |= {"i": f"{quote}{image}{quote}", "n": f"{quote}{name}{quote}"}
        lines.append((separator + gap).join(words[column] for column in order))
    path = folder / "gcp_list.txt"
    path.write_text("\n".join(lines), encoding="utf-8")
    found = read_control_points(path)
    expect([(row.image, row.name) for row in found] == names, "other names")
    expect(np.array_equal([row.xy for row in found], pixels), "other pixels")
    expected = np.column_stack([back[1], back[0], unit * z])
    expect(np.allclose([row.place for row in found], expected, 1e-12, 1e-7), "other places")


TARGETS = (
    Target("rasters", "places of rasters, against rasterio", rasters, 500, 100),
    Target("control-points", "ground control points, against pyproj", control_points, 200, 100),
)
