"""Where the Middlebury stereo scenes of the paper are on the web."""

from __future__ import annotations

import json
from typing import Any

from .contents import known_contents
from .download import RemoteFile
from .remote import RemoteDataset

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
    contents=known_contents("middlebury"),
    texts={name: text for _, texts in _SCENES for name, text in texts.items()},
)
