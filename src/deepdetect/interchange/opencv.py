"""OpenCV: files that `cv::FileStorage` reads into `vector<KeyPoint>`, `vector<DMatch>` and `Mat`.

Its pixels are ours: the centre of the first is (0, 0). Sizes are diameters, angles degrees.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.errors import DeepDetectError
from .._shared.opencv import cv2
from .._shared.options import suggest_keywords
from .._shared.registry import look_up
from ..features.keypoints import Keypoints
from .collection import MATCHES_NAME, Collection, PairMatches, check_matches_name

SUFFIXES = {"yml": ".yml", "yml.gz": ".yml.gz", "xml": ".xml", "json": ".json"}
"""Of the files that OpenCV knows."""

NO_CLASS = -1


@suggest_keywords
def write_opencv(
    collection: Collection, output: str | Path, *, file_format: str = "yml"
) -> tuple[Path, ...]:
    """Write a file for each photograph, and matches.yml.

    NAME.yml has `image`, `image_size` (width, height), `keypoints` and, where there are any,
    `descriptors` (N, D). matches.yml has a sequence `pairs` of maps: `image0`, `image1` and
    `matches`, whose distances are 1 - score.

    Args:
        collection: the photographs.
        output: folder.
        file_format: "yml", "yml.gz", "xml" or "json".

    Returns:
        The files, each of which appears whole, or not at all.

    Raises:
        OptionError: the format is unknown, or a photograph is named "matches", without an ending.
        DeepDetectError: a file cannot be written.

    Example:
        >>> import tempfile
        >>> points = Keypoints([[3, 4.5]], [0.5], (8, 6), sizes=[7], angles=[90])
        >>> path, _ = write_opencv(Collection({"a.jpg": points}), tempfile.mkdtemp())
        >>> storage = cv2.FileStorage(str(path), cv2.FileStorage_READ)
        >>> row = storage.getNode("keypoints").at(0)
        >>> [row.at(k).real() for k in range(5)]
        [3.0, 4.5, 7.0, 90.0, 0.5]
    """
    suffix = look_up("file format", file_format, SUFFIXES)
    check_matches_name(collection.keypoints)
    folder = Path(output)
    written = []
    for name, points in collection.keypoints.items():
        path = folder / f"{name}{suffix}"
        with _storage(path, suffix) as storage:
            storage.write("image", name)
            _write_numbers(storage, "image_size", points.image_size)
            _write_keypoints(storage, points)
            if points.descriptors is not None and len(points):
                storage.write("descriptors", points.descriptors)
        written.append(path)
    path = folder / f"{MATCHES_NAME}{suffix}"
    with _storage(path, suffix) as storage:
        storage.startWriteStruct("pairs", cv2.FileNode_SEQ)
        for (name0, name1), found in collection.matches.items():
            storage.startWriteStruct("", cv2.FileNode_MAP)
            storage.write("image0", name0)
            storage.write("image1", name1)
            _write_matches(storage, found)
            storage.endWriteStruct()
        storage.endWriteStruct()
    return (*written, path)


@contextmanager
def _storage(path: Path, suffix: str) -> Iterator[Any]:
    """Open a file of OpenCV, which appears when the block ends."""
    with atomic_path(path) as temporary:
        # The ending decides the format, and of "a.yml.gz" a temporary name keeps only ".gz".
        named = temporary.with_name(f"{temporary.stem}{suffix}")
        try:
            storage = cv2.FileStorage(str(named), cv2.FileStorage_WRITE)
            if not storage.isOpened():
                raise DeepDetectError(f"OpenCV cannot write {path}: choose another place")
            try:
                yield storage
            finally:
                storage.release()
            named.replace(temporary)
        finally:
            if named != temporary:
                named.unlink(missing_ok=True)


def _write_numbers(storage: Any, name: str, values: Any) -> None:
    storage.startWriteStruct(name, cv2.FileNode_SEQ | cv2.FileNode_FLOW)
    for value in values:
        storage.write("", value)
    storage.endWriteStruct()


def _write_keypoints(storage: Any, points: Keypoints) -> None:
    storage.startWriteStruct("keypoints", cv2.FileNode_SEQ)
    for point in points.to_opencv():
        values = (*point.pt, point.size, point.angle, point.response, point.octave, NO_CLASS)
        _write_numbers(storage, "", values)
    storage.endWriteStruct()


def _write_matches(storage: Any, found: PairMatches) -> None:
    storage.startWriteStruct("matches", cv2.FileNode_SEQ)
    distances = (1 - np.asarray(found.scores, np.float64)).tolist()
    for (row0, row1), distance in zip(found.rows.tolist(), distances, strict=True):
        _write_numbers(storage, "", (row0, row1, 0, distance))
    storage.endWriteStruct()
