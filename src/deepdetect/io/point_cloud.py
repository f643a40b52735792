"""Writing point clouds in one of several formats, which the file's suffix selects."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from numbers import Real
from pathlib import Path

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.options import look_up, suggest_keywords
from ..geometry.point_cloud import UNITS, PointCloud, require_points
from .glb import write_glb
from .html_viewer import write_html_page

Metadata = Mapping[str, str | int | float]
PointCloudWriter = Callable[[PointCloud, Path, Mapping[str, str]], None]


def write_ply(cloud: PointCloud, path: Path, metadata: Mapping[str, str]) -> None:
    """Write binary PLY (Turk, 1994): float x y z, uchar red green blue; 15 bytes per point.

    If the cloud has normals, they are written between position and colour as float nx ny nz, which
    makes 27 bytes per point. Frame, unit and metadata become comments, with "?" for each character
    outside ASCII. No PLY library is used, because none writes comments.
    """
    columns = {"x y z": cloud.points, "nx ny nz": cloud.normals}
    vectors = {names: values for names, values in columns.items() if values is not None}
    kinds = [(names, "<f4", 3) for names in vectors] + [("rgb", "u1", 3)]
    vertices = np.empty(len(cloud), kinds)
    for names, values in {**vectors, "rgb": cloud.colors}.items():
        vertices[names] = values
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment written by deepdetect",
        f"comment unit: {UNITS[cloud.unit]}",
        f"comment frame: {cloud.axes}",
        *(f"comment {name}: {text}" for name, text in metadata.items()),
        f"element vertex {len(cloud)}",
        *(f"property float {axis}" for names in vectors for axis in names.split()),
        *(f"property uchar {colour}" for colour in ("red", "green", "blue")),
        "end_header\n",
    ]
    with path.open("wb") as file:
        file.write("\n".join(header).encode("ascii", "replace"))
        vertices.tofile(file)


POINT_CLOUD_WRITERS: dict[str, PointCloudWriter] = {
    ".ply": write_ply,
    ".glb": write_glb,
    ".html": write_html_page,
}
"""Writers by suffix. To add a format, list a function `(cloud, path, metadata) -> None` here."""


@suggest_keywords
def save_point_cloud(cloud: PointCloud, path: str | Path, metadata: Metadata | None = None) -> None:
    """Write a point cloud to a file atomically.

    Args:
        cloud: at least one point, with colours.
        path: its suffix chooses the format:
            .ply: binary PLY, in the cloud's own frame and unit;
            .glb: binary glTF 2.0, y up and in metres;
            .html: a self-contained interactive viewer.
        metadata: named texts and numbers, such as {"source": "cones", "seconds": 2.5}, stored as
            PLY comments, as glTF extras, or in the page's caption.

    Raises:
        OptionError: the suffix is unknown (the error suggests one), or the cloud is empty.
        DeepDetectError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> cloud = PointCloud(np.zeros((1, 3)), np.zeros((1, 3), np.uint8), "mm")
        >>> save_point_cloud(cloud, Path(tempfile.mkdtemp()) / "model.ply")
        >>> save_point_cloud(cloud, "model.plyy")
        Traceback (most recent call last):
        ...
        deepdetect.OptionError: unknown ending '.plyy': did you mean '.ply'? \
(known: .ply, .glb, .html)
    """
    write = find_writer(path)
    require_points(cloud)
    with atomic_path(path) as temporary:
        write(cloud, temporary, format_metadata(metadata or {}))


def find_writer(path: str | Path) -> PointCloudWriter:
    """Return the writer for a path's suffix; call it to check the suffix before expensive work."""
    return look_up("ending", Path(path).suffix.lower(), POINT_CLOUD_WRITERS)


def format_metadata(metadata: Metadata) -> dict[str, str]:
    """Format each value as one line: integers with commas, others with 4 significant digits.

    Example:
        >>> format_metadata({"points": 49979, "within 1 px": 0.95312, "scene": "the  cones"})
        {'points': '49,979', 'within 1 px': '0.9531', 'scene': 'the cones'}
    """
    return {" ".join(str(name).split()): _text(value) for name, value in metadata.items()}


def _text(value: str | int | float) -> str:
    if isinstance(value, bool) or not isinstance(value, Real):  # numpy's numbers are Real
        return " ".join(str(value).split())
    return f"{int(value):,}" if float(value).is_integer() else f"{value:.4g}"
