"""What a point cloud is written as: one line each.

To add an exporter, write its module beside this one, with a function
`(cloud, path, notes) -> None` that writes the file at that very path, and add its line.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from .._shared.atomic import atomic_path
from .._shared.errors import look_up
from ..geometry.point_cloud import PointCloud, require_points
from .glb import write_glb
from .html_viewer import write_html_page
from .notes import Notes, worded
from .ply import write_ply

EXPORTERS: dict[str, Callable[[PointCloud, Path, Mapping[str, str]], None]] = {
    ".ply": write_ply,
    ".glb": write_glb,
    ".html": write_html_page,
}


def save_point_cloud(cloud: PointCloud, path: str | Path, notes: Notes | None = None) -> None:
    """Write a point cloud, whole or not at all.

    Args:
        cloud: the cloud.
        path: its ending says what is written:
            .ply: binary PLY, in the cloud's own frame and unit (`ply`);
            .glb: binary glTF 2.0, y up and in metres (`glb`);
            .html: a page to turn the cloud in, without network (`html_page`).
        notes: words and figures by name that go into the file, as {"source": "cones",
            "seconds": 2.5}: as comments, as extras, or as the page's caption.

    Raises:
        OptionError: the ending is unknown (the nearest right one is named), or the cloud is
            empty.
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
    write = get_exporter(path)
    require_points(cloud)
    with atomic_path(path) as temporary:
        write(cloud, temporary, worded(notes or {}))


def get_exporter(path: str | Path) -> Callable[[PointCloud, Path, Mapping[str, str]], None]:
    """Find the exporter of a path, as to check an ending before the work begins.

    Raises:
        OptionError: the ending is unknown (the nearest right one is named).
    """
    return look_up("ending", Path(path).suffix.lower(), EXPORTERS)
