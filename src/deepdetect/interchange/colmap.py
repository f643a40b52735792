"""Writing of COLMAP's files: a database, or text files. `sfm.colmap` explains their coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.errors import OptionError
from .._shared.options import suggest_keywords
from ..sfm.colmap import (
    PIXEL_CENTRE,
    CameraIntrinsics,
    import_pycolmap,
    orientations_of,
    sift_bytes,
    write_database,
)
from ..sfm.mapping import verify_pairs
from .collection import Collection, check_names

MATCHES_NAME = "matches"
DEFAULT_SIZE_PX = 3.0
"""Keypoints without a size get this diameter in pixels, as in `describe_collection`."""


@suggest_keywords
def write_colmap(
    collection: Collection,
    output: str | Path,
    *,
    intrinsics: Mapping[str, CameraIntrinsics],
    verify: bool = True,
) -> tuple[Path, ...]:
    """Write a COLMAP database atomically; an existing file is replaced.

    Args:
        collection: the images.
        output: path that ends in .db.
        intrinsics: camera of each image, by image name. Images with the same object share a camera.
        verify: estimate the two-view geometry of each pair, which COLMAP's mapper needs.

    Returns:
        The path of the file.

    Raises:
        OptionError: the output does not end in .db, or an image has no camera.
        MissingExtraError: pycolmap is not installed.
        DeepDetectError: the file cannot be written.
    """
    import_pycolmap("a database of COLMAP")
    path = Path(output)
    if path.suffix.lower() != ".db":
        raise OptionError(f"{path} must end in .db")
    for name in collection.keypoints:
        if name not in intrinsics:
            raise OptionError(f"{name} has no camera: give one in `intrinsics`")
    images = {name: (points, intrinsics[name]) for name, points in collection.keypoints.items()}
    with atomic_path(path) as temporary:
        rows = {pair: found.rows for pair, found in collection.matches.items()}
        write_database(temporary, images, rows)
        if verify and rows:
            verify_pairs(temporary)
    return (path,)


def write_colmap_text(collection: Collection, output: str | Path) -> tuple[Path, ...]:
    """Write text files for `colmap feature_importer` and `colmap matches_importer`.

    Args:
        collection: the images, whose keypoints must have SIFT descriptors.
        output: folder, in which each image gets a file NAME.txt. The matches are written to
            matches.txt, which `colmap matches_importer --match_type raw` reads.

    Returns:
        The paths of the files.

    Raises:
        OptionError: keypoints have no SIFT descriptors, which this format requires; a name in the
            list of matches has a blank; or an image is named "matches", without a suffix.
        DeepDetectError: a file cannot be written.
    """
    check_names(name for pair in collection.matches for name in pair)
    if MATCHES_NAME in collection.keypoints:
        raise OptionError(
            f"the keypoints of {MATCHES_NAME!r} would overwrite the matches: rename that image"
        )
    folder = Path(output)
    written = []
    for name, points in collection.keypoints.items():
        descriptors = sift_bytes(points)
        if descriptors is None:
            raise OptionError(
                f"the keypoints of {name} have no SIFT descriptors, which COLMAP's text files "
                "need: give the folder of the images as `images`, or write a database"
            )
        sizes = np.full(len(points), DEFAULT_SIZE_PX) if points.sizes is None else points.sizes
        frames = np.column_stack([points.xy + PIXEL_CENTRE, sizes / 2, orientations_of(points)])
        path = folder / f"{name}.txt"
        with atomic_path(path) as temporary, temporary.open("w", encoding="ascii") as file:
            file.write(f"{len(points)} {descriptors.shape[1]}\n")
            np.savetxt(
                file,
                np.column_stack([frames, descriptors]),
                fmt=["%.4f"] * 4 + ["%d"] * descriptors.shape[1],
            )
        written.append(path)
    path = folder / f"{MATCHES_NAME}.txt"
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        for (name0, name1), found in collection.matches.items():
            lines = "".join(f"{row0} {row1}\n" for row0, row1 in found.rows.tolist())
            file.write(f"{name0} {name1}\n{lines}\n")
    return (*written, path)
