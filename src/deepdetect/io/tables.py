"""Reading and writing keypoints and matches: npz (without pickles) or CSV."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.errors import ImageError, InvalidFileError, MissingFileError, OptionError, first_line
from .._shared.options import suggest_keywords
from .._shared.records import save_arrays
from ..features.keypoints import Keypoints
from ..features.matches import Evidence, Layer, Matches, TwoViewGeometry

OPTIONAL = ("logits", "sizes", "angles", "descriptors", "descriptor_type")
"""These attributes of keypoints may be None. An npz file contains those that are not None."""

MATCH_VALUES = (
    *("points0", "points1", "scores", "inliers", "subpixel", "indices0", "indices1", "layer"),
    "covariances",
)
"""An npz file contains these attributes of `Matches`, in addition to keypoints and geometry."""

CSV_ROWS = 100_000
"""CSV tables are written in blocks of this many rows. All rows at once would double the memory."""


@suggest_keywords
def save_keypoints(keypoints: Keypoints, path: str | Path) -> None:
    """Write keypoints to a file atomically.

    Args:
        keypoints: keypoints of one image.
        path: ending in .npz or .csv. An npz file has the arrays `keypoints` (N, 2) float32,
            `scores` (N,) float32, `image_size` (width, height), and, if known, `logits`, `sizes`
            and `angles` (N,) float32, `descriptors` (N, D) and `descriptor_type`. A CSV file has
            the columns x, y, score, and, if known, size and angle.

    Raises:
        OptionError: the path has another ending.
        DeepDetectError: the file cannot be written.
    """
    if _format(path) == ".npz":
        arrays = {"keypoints": keypoints.xy, "scores": keypoints.scores}
        optional = {name: getattr(keypoints, name) for name in OPTIONAL}
        known = {name: value for name, value in optional.items() if value is not None}
        save_arrays(path, arrays | {"image_size": keypoints.image_size} | known)
    else:
        columns = [("x,y", keypoints.xy), ("score", keypoints.scores)]
        optional = {"size": keypoints.sizes, "angle": keypoints.angles}
        columns += [(name, values) for name, values in optional.items() if values is not None]
        header = ",".join(name for name, _ in columns)
        _save_csv(path, header, [values for _, values in columns])


@suggest_keywords
def load_keypoints(path: str | Path) -> Keypoints:
    """Read keypoints from the npz file that `save_keypoints` wrote.

    Raises:
        DeepDetectError: the file is missing or has other content.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "keypoints.npz"
        >>> save_keypoints(Keypoints([[3, 4]], [0.9], (20, 10)), path)
        >>> load_keypoints(path)
        Keypoints(1 keypoint in 20x10 pixels, scores 0.9 to 0.9)
    """
    with _arrays_in(path, "keypoints") as arrays:
        optional = {name: arrays[name] for name in OPTIONAL if name in arrays}
        return Keypoints(arrays["keypoints"], arrays["scores"], arrays["image_size"], **optional)


@suggest_keywords
def save_matches(matches: Matches, path: str | Path) -> None:
    """Write matches to a file atomically.

    Args:
        matches: matches of two images, with their keypoints.
        path: ending in .npz or .csv. An npz file has the attributes of `Matches`: `points0` and
            `points1` (M, 2) float32, `indices0` and `indices1` (M,) int32 (the rows of the matched
            keypoints in `keypoints0` and `keypoints1`), `scores` (M,) float32, `inliers` (M,) bool,
            `layer` (M,) int8, `subpixel` bool and `covariances` (M, 2, 2) float32. The keypoints of
            the first image are `keypoints0` (N, 2) float32, `keypoint_scores0` (N,) float32 and
            `image_size0` (width, height); the names for the second image end in 1. If there is a
            geometry, the file has the strings `model`, `scene` and `confidence`, the (3, 3)
            `matrix`, the numbers of `Evidence`, and its L layers as `layer_model` (L,),
            `layer_matrix` (L, 3, 3) and `layer_share` (L,). What is unknown is an empty (0, 0)
            array. A CSV file has the columns x0, y0, x1, y1, score, inlier.

    Raises:
        OptionError: the path has another ending.
        DeepDetectError: the file cannot be written.
    """
    if _format(path) == ".csv":
        columns = [matches.points0, matches.points1, matches.scores, matches.inliers]
        _save_csv(path, "x0,y0,x1,y1,score,inlier", columns)
        return
    values = {name: getattr(matches, name) for name in MATCH_VALUES}
    for side, keypoints in enumerate((matches.keypoints0, matches.keypoints1)):
        values[f"keypoints{side}"] = keypoints.xy
        values[f"keypoint_scores{side}"] = keypoints.scores
        values[f"image_size{side}"] = keypoints.image_size
    if matches.geometry is not None:
        values |= vars(matches.geometry) | vars(matches.geometry.evidence)
        del values["evidence"]
        layers = values.pop("layers")
        values["layer_model"] = np.array([each.model for each in layers], np.str_)
        values["layer_matrix"] = np.array([each.matrix for each in layers]).reshape(-1, 3, 3)
        values["layer_share"] = np.array([each.share for each in layers])
    none = np.empty((0, 0))
    save_arrays(path, {name: none if value is None else value for name, value in values.items()})


@suggest_keywords
def load_matches(path: str | Path) -> Matches:
    """Read matches from the npz file that `save_matches` wrote.

    Returns:
        The matches. Their `seconds` are empty, and their keypoints have only positions and scores.

    Raises:
        DeepDetectError: the file is missing or has other content.
    """
    with _arrays_in(path, "matches") as arrays:
        names = "keypoints", "keypoint_scores", "image_size"
        keypoints = [Keypoints(*(arrays[f"{name}{side}"] for name in names)) for side in (0, 1)]
        geometry = None
        if "model" in arrays:
            evidence = Evidence(**{each.name: arrays[each.name] for each in fields(Evidence)})
            values = {name: arrays[name] for name in ("model", "matrix", "scene", "confidence")}
            columns = (arrays[f"layer_{name}"] for name in ("model", "matrix", "share"))
            layers = [
                Layer(str(model), matrix, float(share))
                for model, matrix, share in zip(*columns, strict=True)
            ]
            geometry = TwoViewGeometry(**values, evidence=evidence, layers=tuple(layers))
        values = {name: arrays[name] for name in MATCH_VALUES}
        return Matches(
            **values, keypoints0=keypoints[0], keypoints1=keypoints[1], geometry=geometry
        )


@contextmanager
def _arrays_in(path: str | Path, content: str) -> Iterator[dict[str, Any]]:
    """Yield the values of an npz file by name; all errors in the block name the file."""
    try:
        with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            yield {name: _value(array) for name, array in arrays.items()}
    except FileNotFoundError:
        raise MissingFileError(f"there is no file {path}: check the path") from None
    except Exception as error:  # NumPy and the zip decoders raise many types of errors
        missing = "it has no array " if isinstance(error, KeyError) else ""
        reason = "it is no .npz file" if "pickle" in str(error) else missing + first_line(error)
        raise InvalidFileError(
            f"{path} contains no {content} ({reason}): give a file of them"
        ) from error


def _value(array: np.ndarray) -> Any:
    """Return an array, or its value if it has no dimensions, or None if it is a (0, 0) matrix."""
    if array.shape == (0, 0):
        return None
    return array if array.ndim else array.item()


def _format(path: str | Path) -> str:
    suffix = Path(path).suffix.lower()
    if suffix not in (".npz", ".csv"):
        raise OptionError(f"{path} must end in .npz or .csv")
    return suffix


def _save_csv(path: str | Path, header: str, columns: list[np.ndarray]) -> None:
    # Scores rank the keypoints, so all digits count: 9 digits tell any two float32 apart.
    digits = ["%.9g" if name == "score" else "%.7g" for name in header.split(",")]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(f"{header}\n".encode())
        for start in range(0, len(columns[0]), CSV_ROWS):
            table = np.column_stack([values[start : start + CSV_ROWS] for values in columns])
            np.savetxt(file, table, fmt=digits, delimiter=",")


def read_matrix(path: Path) -> np.ndarray:
    """Read nine numbers from a text file as a (3, 3) float64 matrix that can be inverted."""
    try:
        matrix = np.array(path.read_text().split(), np.float64).reshape(3, 3)
    except OSError as error:
        raise ImageError(f"{path} cannot be read ({error.strerror}): check the folder") from None
    except ValueError:
        raise ImageError(f"{path} contains no 3x3 matrix: it needs nine numbers") from None
    if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-12:
        raise ImageError(f"{path} contains a matrix that cannot be inverted: get the file again")
    return matrix
