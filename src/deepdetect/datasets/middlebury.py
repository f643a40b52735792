"""Rectified stereo with ground truth: Middlebury 2003 to 2014 (Scharstein and Szeliski).

A scene is a folder with left.png, right.png, disparity.png (of the left view) and a calib.json,
which says how the grey values of the disparity become pixels::

    {"ground_truth": {"file": "disparity.png", "value_per_pixel": 4.0,
                      "resolution_factor": 1.0, "unknown": 0}}

A pixel's disparity in the full-size image is its value / value_per_pixel; resolution_factor is
the width of the map over that of the image.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import ImageError, MissingExtraError, MissingImageError
from .._shared.text_files import read_json
from ..geometry.camera import MAX_FILE_BYTES, read_calibration
from ..io.image import load_image
from ..io.image_file import open_image
from .download import RemoteDataset, RemoteFile
from .types import CalibratedStereoPair, StereoPair


def load_middlebury(folder: str | Path) -> StereoPair:
    """Load a scene with its ground truth, at the size and in the pixels of the images.

    Args:
        folder: the scene.

    Raises:
        ImageError: a file is missing or damaged, or the scene has no ground truth.
    """
    root, left, right = _load_views(folder)
    path = root / "calib.json"
    try:
        truth = read_json(path, MAX_FILE_BYTES).get("ground_truth")
        if truth is None:
            raise ImageError(f"{root} has no ground truth: take a scene that has one")
        value, unknown = float(truth["value_per_pixel"]), float(truth["unknown"])
        file = root / truth["file"]
    except OSError as error:
        raise ImageError(f"{path} cannot be read ({error.strerror}): check the path") from None
    except (ValueError, OverflowError, KeyError, TypeError, AttributeError) as error:
        raise ImageError(f"{path} does not say how its ground truth is stored ({error})") from None
    stored = _load_gray(file) if file.is_file() else None
    if stored is None or not value > 0:
        raise ImageError(
            f"the ground truth {file} is missing, or no grey image with a scale above 0"
        )
    disparity = np.where(stored == unknown, np.nan, stored / value).astype(np.float32)
    return StereoPair(root.name, left, right, _enlarged(disparity, left.shape[:2]))


def _load_gray(path: Path) -> np.ndarray | None:
    """Read the grey values of an image of 8 or 16 bits, None if it has colours."""
    with open_image(path) as image:
        gray = image.mode == "L" or image.mode.startswith("I")
        return np.asarray(image) if gray else None


def load_calibrated_pair(folder: str | Path) -> CalibratedStereoPair:
    """Load a scene with its calib.json, without its ground truth: the disparity is NaN.

    Raises:
        ImageError: an image is missing or damaged, or the two differ in size.
        ReconstructionError: the calibration is missing or damaged.
    """
    root, left, right = _load_views(folder)
    size = (left.shape[1], left.shape[0])
    calibration = read_calibration(root / "calib.json", size, size)
    unknown = np.full(left.shape[:2], np.nan, np.float32)
    return CalibratedStereoPair(root.name, left, right, unknown, calibration)


def load_motorcycle() -> StereoPair:
    """Load the Motorcycle pair of Middlebury 2014 (741x500) and the true disparity.

    It is part of the scikit-image wheel, so nothing is downloaded.

    Raises:
        MissingExtraError: scikit-image is not installed.
    """
    try:
        from skimage import data
    except ImportError:
        raise MissingExtraError(
            "the Motorcycle pair needs the package scikit-image, which is not installed: "
            "run pip install scikit-image"
        ) from None
    left, right, disparity = data.stereo_motorcycle()
    disparity = np.asarray(disparity, np.float32).squeeze()
    unknown = ~np.isfinite(disparity)
    return StereoPair("motorcycle", left, right, np.where(unknown, np.nan, disparity))


def _load_views(folder: str | Path) -> tuple[Path, np.ndarray, np.ndarray]:
    root = Path(folder).resolve()
    if not root.is_dir():
        raise MissingImageError(f"there is no folder {folder}: name the folder of a stereo scene")
    left, right = load_image(root / "left.png"), load_image(root / "right.png")
    if left.shape != right.shape:
        raise ImageError(f"left.png and right.png in {root} differ in size: take a rectified pair")
    return root, left, right


def _enlarged(disparity: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Read a smaller map at each pixel of the image: the nearest of its values."""
    row, column = (
        np.minimum((np.arange(full) + 0.5) * own / full, own - 1).astype(int)
        for full, own in zip(shape, disparity.shape, strict=True)
    )
    return disparity[np.ix_(row, column)]


_HOST = "https://vision.middlebury.edu/stereo/data"
_AUTHORS = (
    "https://raw.githubusercontent.com/saktx/DeepDetect/"
    "f8c2074e315b77df39e9b14d0c40951279f8c04d/Stereo_3D_Reconstruction"
)
"""The paper's authors keep the pairs as they matched them, in two lights."""


def _scene(
    name: str, left: str, right: str, disparity: str | None, calibration: dict[str, Any]
) -> tuple[list[RemoteFile], dict[str, str]]:
    files = [
        RemoteFile((left,), 2_000_000, into=f"{name}/left.png"),
        RemoteFile((right,), 2_000_000, into=f"{name}/right.png"),
    ]
    if disparity is not None:
        files.append(RemoteFile((disparity,), 200_000, into=f"{name}/disparity.png"))
    return files, {f"{name}/calib.json": json.dumps(calibration, indent=1) + "\n"}


def _truth(value_per_pixel: float, resolution_factor: float = 1.0) -> dict[str, Any]:
    return {
        "file": "disparity.png",
        "value_per_pixel": value_per_pixel,
        "resolution_factor": resolution_factor,
        "unknown": 0,
    }


def _quarter_size(name: str) -> tuple[list[RemoteFile], dict[str, str]]:
    """Return a scene of 2003; it has no published calibration."""
    root = f"{_HOST}/scenes2003/newdata/{name}"
    calibration = {"focal_px": 360.0, "ground_truth": _truth(4), "width": 450, "height": 375}
    return _scene(name, f"{root}/im2.png", f"{root}/im6.png", f"{root}/disp2.png", calibration)


def _third_size(name: str) -> tuple[list[RemoteFile], dict[str, str]]:
    """Return a scene of 2005 at a third of its size, views 1 and 5."""
    root = f"{_HOST}/scenes2005/ThirdSize/{name.capitalize()}"
    calibration = {
        "focal_px": 3740 / 3,
        "baseline_mm": 160.0,
        "disparity_offset_px": 200 / 3,
        "ground_truth": _truth(3),
        "width": 463,
        "height": 370,
    }
    return _scene(name, f"{root}/view1.png", f"{root}/view5.png", f"{root}/disp1.png", calibration)


def _full_size(name: str, width: int, truth: bool) -> tuple[list[RemoteFile], dict[str, str]]:
    """Return a scene as the authors matched it: full size, views 1 and 2."""
    calibration: dict[str, Any] = {"focal_px": 3740.0, "baseline_mm": 40.0}
    disparity = None
    if truth:
        # Views 1 and 2 are a quarter as far apart as 1 and 5, whose disparity this is, in thirds.
        disparity = f"{_HOST}/scenes2005/ThirdSize/{name.capitalize()}/disp1.png"
        calibration |= {"disparity_offset_px": 50.0, "ground_truth": _truth(4, 1 / 3)}
    calibration |= {"width": width, "height": 1110}
    return _scene(
        name, f"{_AUTHORS}/{name}1.png", f"{_AUTHORS}/{name}2.png", disparity, calibration
    )


_SCENES = (
    _quarter_size("cones"),
    _quarter_size("teddy"),
    _third_size("art"),
    _full_size("dolls", 1390, truth=True),
    _full_size("moebius", 1390, truth=True),
    _full_size("rocks", 1276, truth=False),
    _full_size("cloth", 1252, truth=False),
)

MIDDLEBURY = RemoteDataset(
    name="middlebury",
    title="Middlebury stereo, the seven pairs of the paper and of the benchmark",
    files=tuple(file for files, _ in _SCENES for file in files),
    images=sum(len(files) for files, _ in _SCENES),
    licence="free to use and publish with citation; Scharstein, Szeliski, Pal, Hirschmüller",
    texts={name: text for _, texts in _SCENES for name, text in texts.items()},
)
