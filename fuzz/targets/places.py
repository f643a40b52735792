"""Files of places, as GDAL and pyproj read them: georeferenced rasters, ground control points."""

from __future__ import annotations

import contextlib
import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from deepdetect.cli import main
from deepdetect.geometry import transform_points
from deepdetect.io.picture_file import read_metadata
from deepdetect.sfm.control_points import read_control_points

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


def as_bands(values: np.ndarray, count: int) -> np.ndarray:
    """Repeat values in all bands, but for the fourth: GDAL makes it alpha."""
    return np.array([values, values, values, np.full_like(values, 255), values, values][:count])


def write_raster(generator: np.random.Generator, stem: Path, values: np.ndarray) -> Path:
    """Write grey values, (H, W) uint8, to a raster of any kind that GDAL places somewhere."""
    import rasterio

    transform, (height, width) = random_transform(generator), values.shape
    kind = str(generator.choice(["tif", *WORLD_FILES]))
    system = str(generator.choice(SYSTEMS)) if generator.random() < 0.7 else None
    if kind == "tif" and generator.random() < 0.7:
        dtype, count = str(generator.choice(TYPES)), int(generator.integers(1, 7))
        how = {"driver": "GTiff", "width": width, "height": height, "count": count}
        how |= {"nodata": 0} if generator.random() < 0.3 else {}
        path = stem.with_suffix(".tif")
        with rasterio.open(path, "w", dtype=dtype, crs=system, transform=transform, **how) as file:
            file.write(as_bands(values, count).astype(dtype))
            if generator.random() < 0.3:
                file.update_tags(AREA_OR_POINT="Point")
        return path
    path = stem.with_suffix(f".{kind.upper() if generator.random() < 0.3 else kind}")
    Image.fromarray(values).convert("RGB").save(path)
    ending = str(generator.choice(WORLD_FILES[kind].split()))
    ending = str(generator.choice([ending, ending.upper(), ending.capitalize()]))
    centre = transform * rasterio.Affine.translation(0.5, 0.5)
    numbers = (centre.a, centre.d, centre.b, centre.e, centre.c, centre.f)
    path.with_suffix(f".{ending}").write_text("".join(f"{each!r}\n" for each in numbers))
    return path


def places(path: Path, pixels: np.ndarray) -> tuple[np.ndarray | None, Any]:
    """Return the places of pixels (N, 2) as rasterio reads them, and the coordinate system."""
    import rasterio

    with rasterio.open(path) as file:
        if file.transform.is_identity:
            return None, file.crs
        return np.array([file.transform * (x + 0.5, y + 0.5) for x, y in pixels]), file.crs


def rasters(generator: np.random.Generator, folder: Path) -> None:
    """Read the place of a raster, write it to another file, and ask rasterio for both."""
    width, height = map(int, generator.integers(2, 40, 2))
    values = generator.integers(0, 100, (height, width)).astype(np.uint8)
    path = write_raster(generator, folder / str(generator.choice(["a", "B c", "ü"])), values)
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1]])
    found = read_metadata(path, placed=True)
    warnings.simplefilter("ignore")
    expected, crs = places(path, corners)
    expect((found.to_world is None) == (expected is None), "a place is lost, or made up")
    if expected is None:
        return
    near = 1e-9 * np.abs(expected).max()
    expect(np.allclose(transform_points(corners, found.to_world), expected, 0, near), "elsewhere")
    expect(found.crs == crs, "another coordinate system")
    found.write_tiff(np.zeros((height, width), np.uint8), folder / "out.tif")
    found.write_beside(folder / "out.png")
    Image.new("L", (width, height)).save(folder / "out.png")
    for name in ("out.tif", "out.png"):
        again, _ = places(folder / name, corners)
        expect(np.allclose(again, expected, 0, near), f"{name} is elsewhere")


def mosaics(generator: np.random.Generator, folder: Path) -> None:
    """Register a picture to a raster, or stitch both; the result lies where the raster does."""
    import cv2
    import rasterio

    scene = cv2.GaussianBlur(generator.random((130, 190)), (0, 0), 2)
    scene = cv2.normalize(scene, None, 1, 255, cv2.NORM_MINMAX).astype(np.uint8)
    shift = int(generator.integers(30, 60))
    raster, other = write_raster(generator, folder / "a", scene[:, :130]), folder / "b.png"
    warnings.simplefilter("ignore")
    with rasterio.open(raster) as file:
        count = file.count
    right = scene[:, shift:]
    if count in (1, 3):
        Image.fromarray(right).save(other)
    else:
        with rasterio.open(
            other := folder / "b.tif", "w", "GTiff", *right.shape[::-1], count, dtype="uint8"
        ) as file:
            file.write(as_bands(right, count))
    bands = [] if count in (1, 3) else ["--bands", "1", "2", "1"]
    words = [str(raster), str(other), "--detector", "points", "--value-range", "0", "255", *bands]
    if generator.random() < 0.5:
        union = ["--extent", "union"] if generator.random() < 0.5 else []
        words = ["register", *words, *union, "--output", str(folder / "out")]
    else:
        name = str(generator.choice(["p.tif", "p.png", "P.JPG"]))
        scale = ["--scale", str(generator.choice([1.0, 0.7]))]
        words = ["stitch", *words, "--reference", str(raster), *scale]
        words += ["--output", str(folder / name)]
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = main(words)
    expect(code == 0, said.getvalue())
    corners, expected_crs = places(raster, np.array([[0, 0], [1, 0], [0, 1]]))
    if corners is None:
        return
    (made,) = [
        *folder.glob("out/b_on_a.[pt][ni][gf]"),
        *(
            each
            for each in folder.glob("[pP].*")
            if each.suffix.lower() in (".tif", ".png", ".jpg")
        ),
    ]
    with rasterio.open(made) as file:
        values = file.read(1).astype(float)
    rows, columns = np.mgrid[10 : values.shape[0] - 10 : 3, 10 : values.shape[1] - 10 : 3]
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    there, crs = places(made, pixels)
    expect(there is not None, "a place is lost")
    axes = np.column_stack([corners[1] - corners[0], corners[2] - corners[0]])
    xy = np.linalg.solve(axes, (there - corners[0]).T).T.astype(np.float32)
    seen = (xy[:, 0] > shift + 2) & (xy[:, 0] < 186) & (xy[:, 1] > 2) & (xy[:, 1] < 126)
    true = cv2.remap(scene, *xy[seen].T[:, None], cv2.INTER_LINEAR)[0]
    alike = np.corrcoef(true, values[tuple(pixels[seen].T[::-1])])
    expect(seen.sum() > 300 and alike[0, 1] > 0.97, f"{words[0]}: {made.name} is elsewhere")
    kept = made.suffix == ".tif" or expected_crs is None
    expect(crs == expected_crs or not kept, f"{made.name} has another coordinate system")


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
    Target("mosaics", "registered and stitched rasters, against rasterio", mosaics, 500, 100),
    Target("control-points", "ground control points, against pyproj", control_points, 200, 100),
)
