"""Whether a mapped camera is that of a pinhole, or a fisheye, for which the mapping bent the scene."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from .._shared.errors import NoDepthError
from .colmap import quiet_pycolmap
from .mapping import ROBUST_SCALE_PX, ROUGH_TOLERANCE, adjust

USUAL_DISTORTION = 0.05
"""A lens that moves no pixel by more than this part of its distance from the centre is no fisheye:
photographic lenses stay below it, and a fisheye of 100 degrees comes out with 0.1."""

MIN_DEVIATIONS = 4.0
"""A fisheye explains a camera better if the mean difference of the costs of its observations is
this many standard deviations of that mean above 0 (Vuong's test of models of equal size)."""

SERIES = (1 / 3, 2 / 15)
"""Coefficients of tan(x) = x + x^3 / 3 + 2 x^5 / 15, with which a fisheye is nearly a pinhole."""


def require_pinholes(model: Any) -> None:
    """Raise a NoDepthError if fisheyes explain the observations of a model better than pinholes.

    `model` is a `pycolmap.Reconstruction` with estimated "SIMPLE_RADIAL" cameras. If one of them
    distorts strongly, two copies are bundle-adjusted: with two parameters of radial distortion of a
    pinhole, and with two of a fisheye.
    """
    suspects = {number for number, camera in model.cameras.items() if _distorts(model, camera)}
    if not suspects:
        return
    pinhole, fisheye = (_costs(model, suspects, name) for name in ("RADIAL", "RADIAL_FISHEYE"))
    for number in sorted(suspects):
        common = sorted(pinhole[number].keys() & fisheye[number].keys())
        better = np.array([pinhole[number][key] - fisheye[number][key] for key in common])
        if better.mean() > MIN_DEVIATIONS * better.std() / np.sqrt(len(better)):
            names = sorted(image.name for image in _images(model, number))
            raise NoDepthError(
                f"{names[0]} and other images are of a fisheye, which the geometry of pinholes does "
                "not fit: cut them into pinhole views, such as by "
                f"ffmpeg -i {names[0]} -vf v360=fisheye:flat:ih_fov=170:iv_fov=170:h_fov=90:v_fov=90 "
                "view.png, or undistort them and give `calibration`"
            )


def _images(model: Any, camera: int) -> Iterator[Any]:
    for number in model.reg_image_ids():
        if model.images[number].camera_id == camera:
            yield model.images[number]


def _distorts(model: Any, camera: Any) -> bool:
    focal, *centre, distortion = camera.params
    places = [
        point.xy
        for image in _images(model, camera.camera_id)
        for point in image.points2D
        if point.has_point3D()
    ]
    if not places:
        return False
    reach = np.linalg.norm(np.array(places) - centre, axis=1).max() / focal
    return bool(distortion * reach**2 < -USUAL_DISTORTION)


def _costs(model: Any, suspects: set[int], name: str) -> dict[int, dict[tuple[int, int], float]]:
    """Bundle-adjust a copy with another camera model; return the costs of each camera's points.

    The costs are those of the robust loss, by the numbers of an image and of its keypoint.
    """
    with quiet_pycolmap() as pycolmap:
        copy = pycolmap.Reconstruction(model)
    for number in suspects:
        camera = copy.cameras[number]
        first = (SERIES[0], SERIES[1]) if name == "RADIAL_FISHEYE" else (0.0, 0.0)
        start = [*camera.params[:3], camera.params[3] + first[0], first[1]]
        camera.model = getattr(pycolmap.CameraModelId, name)
        camera.params = start
    adjust(copy, False, ROUGH_TOLERANCE)
    costs: dict[int, dict[tuple[int, int], float]] = {number: {} for number in suspects}
    for number in suspects:
        for image in _images(copy, number):
            seen = [(k, p) for k, p in enumerate(image.points2D) if p.has_point3D()]
            points = np.array([copy.points3D[p.point3D_id].xyz for _, p in seen]).reshape(-1, 3)
            places = np.array([p.xy for _, p in seen]).reshape(-1, 2)
            pose = image.cam_from_world()
            rays = points @ pose.rotation.matrix().T + pose.translation
            found = copy.cameras[number].img_from_cam(np.ascontiguousarray(rays))
            squares = ((found - places) ** 2).sum(axis=1) / ROBUST_SCALE_PX**2
            for (k, _), square in zip(seen, squares, strict=True):
                if np.isfinite(square):
                    costs[number][image.image_id, k] = float(np.log1p(square))
    return costs
