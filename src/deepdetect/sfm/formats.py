"""Write a model as point clouds and maps in UTM, meshes, or inputs for Gaussian splatting."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.errors import ReconstructionError, check_name, require_packages
from ..geometry.point_cloud import BOX_PERCENTILE, PointCloud, robust_box
from ..io.glb import write_glb
from ..io.picture_file import Metadata
from ..io.point_cloud import save_point_cloud
from .colmap import quiet_pycolmap
from .georeference import Georeference
from .result import MultiViewReconstruction
from .splat import write_splat

FormatName = Literal["laz", "map", "mesh", "splat", "text"]

LAZ_STEP_M = 0.001
"""Coordinates in LAZ files are rounded to multiples of this, in metres."""

MESH_MARGIN, MESH_DEPTHS, MESH_TRIM = 0.5, (6, 12), 3
"""A mesh uses the points in their robust bounding box, extended on each side by `MESH_MARGIN` of
its size. `MESH_DEPTHS` limits the number of levels of its octree. The surface is cut away where
sparse points make the octree over `MESH_TRIM` levels coarser. Chosen by hand."""

MIN_MESH_POINTS = 100
"""A mesh needs this number of points: with only a handful, COLMAP's meshing crashes the process."""

COLORS = ("red", "green", "blue")

POINTS_PER_CELL = 4.0
"""Cells of a map hold this number of points on average, so that few stay empty. Chosen by hand."""

MAX_MAP_SIDE = 10_000
"""A map has at most this number of rows and columns, which limits the memory and the file size."""


def write_laz(found: MultiViewReconstruction, folder: Path, output: Path) -> None:
    """Write model.laz (LAS 1.4, point format 7): the points in UTM, with 16-bit colours."""
    import laspy
    from pyproj import CRS

    xyz, epsg = _in_utm(found, "a LAZ file")
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.offsets, header.scales = np.floor(xyz.min(axis=0)), np.full(3, LAZ_STEP_M)
    header.add_crs(CRS.from_epsg(epsg))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    # Colours are scaled from 8 to 16 bits: 255 becomes 65535.
    las.red, las.green, las.blue = found.cloud.colors.astype(np.uint16).T * 257
    with atomic_path(output / "model.laz") as path, path.open("wb") as file:
        las.write(file, do_compress=True)


def write_map(found: MultiViewReconstruction, folder: Path, output: Path) -> None:
    """Write height.tif (in metres) and orthophoto.tif, both as GeoTIFF in UTM with north up.

    A cell takes height and colour from the point with the median height of its points. A cell
    without points has the height NaN and the colour 0, which mean "no data".
    """
    xyz, epsg = _in_utm(found, "a map")
    low, high = np.percentile(xyz, (BOX_PERCENTILE, 100 - BOX_PERCENTILE), axis=0)
    margin = BOX_PERCENTILE / 50 * (high - low)
    inside = ((xyz >= low - margin) & (xyz <= high + margin)).all(axis=1)
    xyz, colors = xyz[inside], found.cloud.colors[inside]
    size = xyz[:, :2].max(axis=0) - xyz[:, :2].min(axis=0)
    cell = max(float(np.sqrt(size.prod() * POINTS_PER_CELL / len(xyz))), size.max() / MAX_MAP_SIDE)
    cell = float(f"{cell:.2g}") or 1.0
    west, north = np.floor(xyz[:, 0].min() / cell), np.ceil(xyz[:, 1].max() / cell)
    column = np.floor(xyz[:, 0] / cell - west).astype(np.int64)
    row = np.floor(north - xyz[:, 1] / cell).astype(np.int64)
    width, height = int(column.max()) + 1, int(row.max()) + 1
    cells = row * width + column
    order = np.lexsort((xyz[:, 2], cells))
    filled, start, count = np.unique(cells[order], return_index=True, return_counts=True)
    middle = order[start + count // 2]
    heights = np.full((height, width), np.nan, np.float32)
    heights.flat[filled] = xyz[middle, 2]
    photo = np.zeros((height * width, 3), np.uint8)
    photo[filled] = colors[middle]
    corner = cell * np.array([west + 0.5, north - 0.5])
    to_world = np.array([[cell, 0, corner[0]], [0, -cell, corner[1]], [0, 0, 1.0]])
    place = Metadata(to_world, f"EPSG:{epsg}")
    replace(place, no_data=np.nan).write_tiff(heights, output / "height.tif")
    bands = photo.reshape(height, width, 3)
    replace(place, no_data=0).write_tiff(bands, output / "orthophoto.tif")


def _in_utm(found: MultiViewReconstruction, what: str) -> tuple[np.ndarray, int]:
    place = found.georeference
    if not isinstance(place, Georeference) or place.origin is None:
        how = "take photographs with GPS, or give ground control points"
        raise ReconstructionError(f"{what} needs a georeferenced model: {how}")
    return place.origin.to_utm(found.cloud.points)


def write_text(found: MultiViewReconstruction, folder: Path, output: Path) -> None:
    """Write sparse_text/: the sparse model in COLMAP's text format."""
    (output / "sparse_text").mkdir(exist_ok=True)
    with quiet_pycolmap() as pycolmap:
        pycolmap.Reconstruction(output / "sparse" / "0").write_text(output / "sparse_text")


def write_mesh(found: MultiViewReconstruction, folder: Path, output: Path) -> None:
    """Write mesh.ply and mesh.glb: COLMAP's screened Poisson surface (Kazhdan and Hoppe, 2013)."""
    cloud = found.dense
    if len(cloud):
        box = robust_box(cloud)
        margin = MESH_MARGIN * (box.high - box.low)
        inside = (cloud.points >= box.low - margin) & (cloud.points <= box.high + margin)
        cloud = cloud[inside.all(axis=1)]
    if len(cloud) < MIN_MESH_POINTS:
        raise ReconstructionError(
            f"a mesh needs at least {MIN_MESH_POINTS} dense points, and there are {len(cloud)}: "
            "take more images, closer together, or leave out the format 'mesh'"
        )
    # Points lie on surfaces, so N points need about sqrt(N) cells along a side of the octree.
    depth = round(float(np.clip(np.log2(np.sqrt(len(cloud))), *MESH_DEPTHS)))
    with tempfile.TemporaryDirectory(prefix="deepdetect-") as space:
        points, surface = Path(space) / "points.ply", Path(space) / "mesh.ply"
        save_point_cloud(cloud, points)
        with quiet_pycolmap() as pycolmap:
            how = pycolmap.PoissonMeshingOptions(depth=depth, trim=depth - MESH_TRIM)
            pycolmap.poisson_meshing(points, surface, how)
        vertices, faces = _read_mesh(surface)
        with atomic_path(output / "mesh.ply") as path:
            shutil.copyfile(surface, path)
    xyz, rgb = (np.column_stack([vertices[n] for n in k]) for k in ("xyz", COLORS))
    mesh = PointCloud(xyz, rgb, cloud.unit, cloud.frame)
    with atomic_path(output / "mesh.glb") as path:
        write_glb(mesh, path, {"title": "mesh"}, faces)


def _read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices of COLMAP's PLY mesh, as a structured array, and the triangles (M, 3)."""
    header, _, data = path.read_bytes().partition(b"end_header\n")
    counts = [int(number) for number in re.findall(rb"element \w+ (\d+)", header)]
    fields = re.findall(r"property (float|uchar) (\w+)", header.decode("ascii"))
    kinds = {"float": "<f4", "uchar": "u1"}
    vertices = np.frombuffer(data, [(name, kinds[kind]) for kind, name in fields], counts[0])
    of_count = "u1" if b"property list uchar" in header else "<i4"
    triangle = np.dtype([("count", of_count), ("corners", "<i4", 3)])
    triangles = np.frombuffer(data, triangle, counts[1], vertices.nbytes)
    return vertices, triangles["corners"]


class Format(NamedTuple):
    """A file format of a model: how it is written, its files, and the packages that it needs.

    `write` takes the model, the folder of the images and the output folder.
    """

    write: Callable[[MultiViewReconstruction, Path, Path], None]
    files: tuple[str, ...]
    packages: tuple[str, ...] = ()
    placed: bool = False  # whether the format needs a georeferenced model


FORMATS: dict[FormatName, Format] = {
    "laz": Format(write_laz, ("model.laz",), ("laspy", "lazrs", "pyproj"), True),
    "map": Format(write_map, ("height.tif", "orthophoto.tif"), ("rasterio",), True),
    "mesh": Format(write_mesh, ("mesh.ply", "mesh.glb")),
    "splat": Format(write_splat, ("splat",)),
    "text": Format(write_text, ("sparse_text",)),
}


def check_formats(names: Sequence[FormatName]) -> None:
    """Raise an error if a format is unknown or one of its packages is missing."""
    for name in names:
        check_name("format", name, FORMATS)
        require_packages(f"the format {name}", *FORMATS[name].packages)
