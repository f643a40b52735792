"""Keypoints and matches in files: npz or CSV, never pickles."""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.errors import InvalidFileError, MissingFileError, OptionError, first_line
from .._shared.options import suggest_keywords
from ..features.keypoints import Keypoints
from ..features.matches import Matches, TwoViewGeometry

FORMATS = ("npz", "csv")
OPTIONAL = ("logits", "sizes", "angles", "descriptors", "descriptor_type")
"""Of keypoints, in npz files where there are any."""

MAX_DEFLATE_RATIO = 1032
"""By how much zip's usual compression can shrink at most (https://zlib.net/zlib_tech.html)."""

CSV_ROWS = 100_000
"""Written at a time: a table of all takes as much memory as the keypoints once more."""


@suggest_keywords
def save_keypoints(keypoints: Keypoints, path: str | Path) -> None:
    """Write keypoints, whole or not at all.

    Args:
        keypoints: the keypoints.
        path: ending in .npz (arrays `keypoints` (N, 2) float32, `scores` (N,) float32,
            `image_size` (width, height), and where there are any `logits`, `sizes` and `angles`
            (N,) float32, `descriptors` (N, D) and `descriptor_type`) or .csv (columns x, y, score,
            and size and angle where there are any).

    Raises:
        OptionError: the file's ending is another.
        DeepDetectError: the file cannot be written.
    """
    if _format(path) == "npz":
        optional = {name: getattr(keypoints, name) for name in OPTIONAL}
        _save_npz(
            path,
            keypoints=keypoints.xy,
            scores=keypoints.scores,
            image_size=np.array(keypoints.image_size),
            **{name: np.asarray(each) for name, each in optional.items() if each is not None},
        )
    else:
        columns = [("x,y", keypoints.xy), ("score", keypoints.scores)]
        known = (("size", keypoints.sizes), ("angle", keypoints.angles))
        columns += [(name, values) for name, values in known if values is not None]
        header = ",".join(name for name, _ in columns)
        _save_csv(path, header, [values for _, values in columns])


@suggest_keywords
def load_keypoints(path: str | Path) -> Keypoints:
    """Read keypoints from the npz file that `save_keypoints` wrote.

    Raises:
        DeepDetectError: the file is missing or is no such file.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "keypoints.npz"
        >>> save_keypoints(Keypoints([[3, 4]], [0.9], (20, 10)), path)
        >>> load_keypoints(path)
        Keypoints(1 keypoint in 20x10 pixels, scores 0.9 to 0.9)
    """
    arrays = _load_npz(path, "keypoints")
    with _building(path, "keypoints"):
        kind = arrays.pop("descriptor_type", None)
        return Keypoints(
            arrays["keypoints"],
            arrays["scores"],
            _size(arrays["image_size"]),
            **{name: arrays[name] for name in OPTIONAL if name in arrays},
            descriptor_type=None if kind is None else str(kind),
        )


@suggest_keywords
def save_matches(matches: Matches, path: str | Path) -> None:
    """Write matches, whole or not at all.

    Args:
        matches: the matches.
        path: ending in .npz (arrays named as the attributes of `Matches`: `points0` and `points1`
            (M, 2) float32, `indices0` and `indices1` (M,) int32 rows of the keypoints, `scores`
            (M,) float32, `inliers` (M,) bool, `model` a string, `matrix` (3, 3), or (0, 0) without
            one; `guided` and `subpixel` bool; `keypoints0` (N, 2) float32, `keypoint_scores0` (N,)
            float32 and `image_size0` (width, height), and the same of the second image; and of a
            `TwoViewGeometry` its attributes, as `two_view_model`) or .csv (columns x0, y0, x1, y1,
            score, inlier).

    Raises:
        OptionError: the file's ending is another.
        DeepDetectError: the file cannot be written.
    """
    if _format(path) == "csv":
        columns = [matches.points0, matches.points1, matches.scores, matches.inliers]
        _save_csv(path, "x0,y0,x1,y1,score,inlier", columns)
        return
    names = ("points0", "points1", "scores", "inliers", "indices0", "indices1")
    arrays = {name: getattr(matches, name) for name in names}
    arrays |= {"model": matches.model, "matrix": _or_empty(matches.matrix)}
    arrays |= {"guided": matches.guided, "subpixel": matches.subpixel}
    for side, keypoints in enumerate((matches.keypoints0, matches.keypoints1)):
        arrays[f"keypoints{side}"] = keypoints.xy
        arrays[f"keypoint_scores{side}"] = keypoints.scores
        arrays[f"image_size{side}"] = keypoints.image_size
    if matches.two_view_geometry is not None:
        arrays |= {
            f"two_view_{name}": value for name, value in vars(matches.two_view_geometry).items()
        }
        arrays["two_view_matrix"] = _or_empty(matches.two_view_geometry.matrix)
    _save_npz(path, **{name: np.asarray(value) for name, value in arrays.items()})


@suggest_keywords
def load_matches(path: str | Path) -> Matches:
    """Read matches from the npz file that `save_matches` wrote.

    Returns:
        The matches. Their `seconds` are empty, and their keypoints have no logits.

    Raises:
        DeepDetectError: the file is missing or is no such file.
    """
    arrays = _load_npz(path, "matches")
    with _building(path, "matches"):
        keypoints = [
            Keypoints(
                arrays[f"keypoints{side}"],
                arrays[f"keypoint_scores{side}"],
                _size(arrays[f"image_size{side}"]),
            )
            for side in (0, 1)
        ]
        geometry = None
        if "two_view_model" in arrays:
            geometry = TwoViewGeometry(
                str(arrays["two_view_model"]),
                _or_none(arrays["two_view_matrix"]),
                _integer(arrays["two_view_tentative_matches"]),
                _integer(arrays["two_view_tentative_inliers"]),
                float(arrays["two_view_log10_nfa"]),
                _integer(arrays["two_view_simulated_views"]),
            )
        return Matches(
            arrays["points0"],
            arrays["points1"],
            arrays["scores"],
            arrays["inliers"],
            str(arrays["model"]),
            _or_none(arrays["matrix"]),
            keypoints[0],
            keypoints[1],
            two_view_geometry=geometry,
            subpixel=bool(arrays["subpixel"]),
            indices0=arrays["indices0"],
            indices1=arrays["indices1"],
        )


def _load_npz(path: str | Path, content: str) -> dict[str, np.ndarray]:
    """Read all arrays of a npz file; errors say which file and what it should hold."""
    try:
        with Path(path).open("rb") as file:
            _check_npz(file)
            with np.load(file, allow_pickle=False) as arrays:
                return dict(arrays)
    except FileNotFoundError:
        raise MissingFileError(f"there is no file {path}: check the path") from None
    except Exception as error:  # zip, its compressions and NumPy raise many kinds
        raise _holds_none(path, content, error) from None


@contextmanager
def _building(path: str | Path, content: str) -> Iterator[None]:
    """Say of which file the arrays are that do not make the object."""
    try:
        yield
    except (KeyError, ValueError, TypeError) as error:
        raise _holds_none(path, content, error) from error


def _holds_none(path: str | Path, content: str, error: Exception) -> InvalidFileError:
    reason = first_line(error)
    if isinstance(error, KeyError):
        reason = f"it has no array {reason}"
    return InvalidFileError(f"{path} holds no {content} ({reason}): write the file again")


def _size(array: np.ndarray) -> tuple[int, int]:
    if array.shape != (2,):
        raise ValueError(f"an image size has two numbers, not shape {array.shape}")
    return _integer(array[0]), _integer(array[1])


def _integer(array: np.ndarray) -> int:
    if not np.isfinite(array).all():
        raise ValueError(f"a whole number is {array}")
    return int(array)


def _check_npz(file: BinaryIO) -> None:
    """Raise a ValueError where arrays have not the sizes they state: NumPy allocates them first."""
    length = file.seek(0, os.SEEK_END)
    with zipfile.ZipFile(file) as archive:
        for entry in archive.infolist():
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"{entry.filename} is compressed in an unknown way")
            if entry.file_size > MAX_DEFLATE_RATIO * min(entry.compress_size, length):
                raise ValueError(f"{entry.filename} states a wrong size")
            with archive.open(entry) as member:
                version = np.lib.format.read_magic(member)
                # Version 3.0 is 2.0 with names of columns in UTF-8, which ours do not have.
                read_header = (
                    np.lib.format.read_array_header_1_0
                    if version == (1, 0)
                    else np.lib.format.read_array_header_2_0
                )
                shape, _, dtype = read_header(member)
                if math.prod(shape) * dtype.itemsize != entry.file_size - member.tell():
                    raise ValueError(f"{entry.filename} does not have the size that it states")
    file.seek(0)


def _or_empty(matrix: np.ndarray | None) -> np.ndarray:
    return np.empty((0, 0)) if matrix is None else matrix


def _or_none(matrix: np.ndarray) -> np.ndarray | None:
    return matrix if matrix.size else None


def _format(path: str | Path) -> str:
    suffix = Path(path).suffix.lower().removeprefix(".")
    if suffix not in FORMATS:
        raise OptionError(f"{path} must end in .npz or .csv")
    return suffix


def _save_npz(path: str | Path, **arrays: np.ndarray) -> None:
    # Coordinates of dense points shrink to a tenth; NumPy's own level takes five times as long for
    # a twentieth less.
    with (
        atomic_path(path) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
    ):
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asanyarray(array), allow_pickle=False)


def _save_csv(path: str | Path, header: str, columns: list[np.ndarray]) -> None:
    # Scores rank: no two that differ may be rounded to one.
    digits = ["%.9g" if name == "score" else "%.7g" for name in header.split(",")]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(f"{header}\n".encode())
        for start in range(0, len(columns[0]), CSV_ROWS):
            table = np.column_stack([values[start : start + CSV_ROWS] for values in columns])
            np.savetxt(file, table, fmt=digits, delimiter=",")
