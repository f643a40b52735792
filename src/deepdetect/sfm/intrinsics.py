"""Intrinsics of photographs: by a calibration, EXIF, or a guess that is estimated further."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import ReconstructionError
from ..geometry.camera import Calibration, Camera, read_calibration
from ..io.exif import camera_from_exif
from .lens import Lens


@dataclass(frozen=True, eq=False)
class KnownCameras:
    """What a calibration says of photographs.

    Attributes:
        known: their cameras by name; none without a calibration.
        refused: why it is not for the others, by name.
    """

    known: dict[str, Camera]
    refused: dict[str, str]


def known_cameras(
    calibration: Camera | Calibration | str | Path | None, sizes: Mapping[str, tuple[int, int]]
) -> KnownCameras:
    """Return the cameras of photographs by a calibration, which is for one size.

    Raises:
        ReconstructionError: it is wrong, or for none of them.

    Example:
        >>> camera = Camera((640, 480), 500.0)
        >>> found = known_cameras(camera, {"a.jpg": (640, 480), "b.jpg": (320, 240)})
        >>> list(found.known), found.refused["b.jpg"]
        (['a.jpg'], 'it is 320x240 pixels, and the calibration is for another size')
    """
    known: dict[str, Camera] = {}
    refused: dict[str, str] = {}
    if calibration is None:
        return KnownCameras(known, refused)
    problem: ReconstructionError | None = None
    for name, size in sizes.items():
        try:
            known[name] = _known_camera(calibration, size)
        except ReconstructionError as error:
            problem = error
            refused[name] = (
                f"it is {size[0]}x{size[1]} pixels, and the calibration is for another size"
            )
    if problem is not None and not known:
        raise problem
    return KnownCameras(known, refused)


def _known_camera(calibration: Camera | Calibration | str | Path, size: tuple[int, int]) -> Camera:
    """Return the camera of a photograph by a calibration."""
    if not isinstance(calibration, (Camera, Calibration)):
        return read_calibration(calibration, size, size).camera0
    camera = calibration.camera0 if isinstance(calibration, Calibration) else calibration
    if camera.size != size:
        raise ReconstructionError(
            f"the calibration is for images of {camera.size[0]}x{camera.size[1]} pixels, the "
            f"photographs have {size[0]}x{size[1]}: give the calibration of this size"
        )
    return camera


def _lens_by_exif(path: Path, size: tuple[int, int]) -> Lens:
    """Return a lens to be estimated, beginning with the focal length of EXIF where it is there."""
    try:
        return Lens.initial(size, float(np.mean(camera_from_exif(path, size).focal_px)))
    except ReconstructionError:
        return Lens.initial(size)


def photograph_lenses(
    folder: Path,
    names: Sequence[str],
    sizes: Mapping[str, tuple[int, int]],
    known: Mapping[str, Camera],
    focal_px: float | None = None,
    single_camera: bool | None = None,
) -> dict[str, Lens]:
    """Return the camera of each photograph, the same object for those that share one.

    Args:
        folder: of the photographs.
        names: of the photographs.
        sizes: (width, height) by name.
        known: cameras that are known, by name.
        focal_px: focal length of the others; None: of their EXIF, or a guess.
        single_camera: as of `MultiViewOptions`.
    """
    shared: dict[tuple[Any, ...], Lens] = {}
    lenses = {}
    for name in names:
        size = sizes[name]
        if name in known:
            lens = Lens.of_camera(known[name])
        elif focal_px is not None:
            focal = Camera(size, focal_px).focal_px[0]
            lens = replace(Lens.initial(size, focal), source="focal_px")
        else:
            lens = _lens_by_exif(folder / name, size)
        key: tuple[Any, ...] = (lens,)
        if single_camera is not None:
            key = (size,) if single_camera else (name,)
        lenses[name] = shared.setdefault(key, lens)
    return lenses
