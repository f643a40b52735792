"""Keypoints and matches in files: npz or CSV, never pickles."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.errors import DeepDetectError, OptionError
from ..features.keypoints import Keypoints

FORMATS = ("npz", "csv")


class MatchesLike(Protocol):
    """What `save_matches` writes: the attributes of `deepdetect.Matches` that it reads."""

    points0: np.ndarray
    points1: np.ndarray
    ratios: np.ndarray
    inliers: np.ndarray
    model: np.ndarray | None
    kind: str
    guidance: Any

    @property
    def guided(self) -> bool:
        """Whether the matches were guided."""


def save_keypoints(keypoints: Keypoints, path: str | Path) -> None:
    """Write keypoints, whole or not at all.

    Args:
        keypoints: the keypoints.
        path: ending in .npz (arrays `keypoints` (N, 2) float32, `scores` (N,) float32,
            `image_size` (width, height), and `logits` (N,) float32 where there are) or .csv
            (columns x, y, score).

    Raises:
        OptionError: the file's ending is another.
        DeepDetectError: the file cannot be written.
    """
    if _format(path) == "npz":
        _save_npz(
            path,
            keypoints=keypoints.xy,
            scores=keypoints.scores,
            image_size=np.array(keypoints.image_size),
            **({} if keypoints.logits is None else {"logits": keypoints.logits}),
        )
    else:
        _save_csv(path, "x,y,score", np.column_stack([keypoints.xy, keypoints.scores]))


def load_keypoints(path: str | Path) -> Keypoints:
    """Read keypoints from the npz file that `save_keypoints` wrote.

    Raises:
        DeepDetectError: the file is missing or is no such file.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return Keypoints(
                arrays["keypoints"],
                arrays["scores"],
                tuple(arrays["image_size"]),
                arrays.get("logits"),
            )
    except FileNotFoundError:
        raise DeepDetectError(f"there is no file {path}: check the path") from None
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise DeepDetectError(f"{path} holds no keypoints ({error}): write it anew") from None


def save_matches(matches: MatchesLike, path: str | Path) -> None:
    """Write matches, whole or not at all.

    Args:
        matches: the matches.
        path: ending in .npz (arrays `points0` and `points1` (M, 2) float32, `ratios`
            (M,) float32, `inliers` (M,) bool, `model` (3, 3), or (0, 0) without one, `kind` of
            that model, `guided` bool, and `guidance`: what guided, "homography" or
            "fundamental", or "none") or .csv (columns x0, y0, x1, y1, ratio, inlier; it does
            not say what guided). What the ratios are depends on `guided` (`Matches`).

    Raises:
        OptionError: the file's ending is another.
        DeepDetectError: the file cannot be written.
    """
    if _format(path) == "npz":
        _save_npz(
            path,
            points0=matches.points0,
            points1=matches.points1,
            ratios=matches.ratios,
            inliers=matches.inliers,
            model=np.empty((0, 0)) if matches.model is None else matches.model,
            kind=np.array(matches.kind),
            guided=np.array(matches.guided),
            guidance=np.array("none" if matches.guidance is None else matches.guidance.kind),
        )
    else:
        columns = [matches.points0, matches.points1, matches.ratios, matches.inliers]
        _save_csv(path, "x0,y0,x1,y1,ratio,inlier", np.column_stack(columns))


def _format(path: str | Path) -> str:
    suffix = Path(path).suffix.lower().removeprefix(".")
    if suffix not in FORMATS:
        raise OptionError(f"{path} must end in .npz or .csv")
    return suffix


def _save_npz(path: str | Path, **arrays: np.ndarray) -> None:
    # Compressed: coordinates of dense points shrink to a tenth.
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)


def _save_csv(path: str | Path, header: str, table: np.ndarray) -> None:
    with atomic_path(path) as temporary:
        np.savetxt(temporary, table, fmt="%.7g", delimiter=",", header=header, comments="")
