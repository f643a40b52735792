"""Intrinsics of images with distortion, in COLMAP's models: by a calibration, EXIF, or a guess."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import ReconstructionError
from .._shared.opencv import cv2
from ..geometry.camera import Calibration, Camera, read_calibration
from ..io.exif import camera_from_exif
from .colmap import PIXEL_CENTRE, import_pycolmap

ESTIMATED_FOCAL_FACTOR = 1.2
"""Focal length over the longer side, where nothing is known: where its estimation begins."""


@dataclass(frozen=True)
class CameraIntrinsics:
    """One of COLMAP's camera models with its parameters; focal lengths and centre come first.

    Attributes:
        model: name, as "PINHOLE" or "SIMPLE_RADIAL".
        size: (width, height) in pixels.
        params: as COLMAP has them, where the centre of the first pixel is (0.5, 0.5).
        source: where they come from: "given", "focal_px", "EXIF", or "estimated".
    """

    model: str
    size: tuple[int, int]
    params: tuple[float, ...]
    source: str = "given"

    @classmethod
    def of_camera(cls, camera: Camera) -> CameraIntrinsics:
        """Return the intrinsics of a known pinhole camera."""
        centre = (camera.centre[0] + PIXEL_CENTRE, camera.centre[1] + PIXEL_CENTRE)
        return cls("PINHOLE", camera.size, (*camera.focal_px, *centre))

    @classmethod
    def initial(
        cls, size: tuple[int, int], focal_px: float | None = None, source: str = "EXIF"
    ) -> CameraIntrinsics:
        """Return intrinsics to be estimated, with one parameter of radial distortion.

        The estimation begins with `focal_px`, or a guess; `source` is that of the focal length.
        """
        if focal_px is None:
            focal_px, source = ESTIMATED_FOCAL_FACTOR * max(size), "estimated"
        return cls("SIMPLE_RADIAL", size, (focal_px, size[0] / 2, size[1] / 2, 0.0), source)

    @classmethod
    def of_colmap(cls, camera: Any, source: str = "given") -> CameraIntrinsics:
        """Return the intrinsics of a camera of pycolmap."""
        size = (int(camera.width), int(camera.height))
        return cls(camera.model_name, size, tuple(map(float, camera.params)), source)

    def colmap_camera(self) -> Any:
        """Return the camera of pycolmap."""
        pycolmap = import_pycolmap()
        camera = pycolmap.Camera(
            model=self.model, width=self.size[0], height=self.size[1], params=list(self.params)
        )
        camera.has_prior_focal_length = self.source != "estimated"
        return camera

    @property
    def distorts(self) -> bool:
        """Whether its images differ from those of a pinhole camera."""
        return self.model not in ("PINHOLE", "SIMPLE_PINHOLE")

    @property
    def pinhole(self) -> Camera:
        """The camera without the distortion."""
        camera = self.colmap_camera()
        focal = (float(camera.focal_length_x), float(camera.focal_length_y))
        centre = (float(camera.principal_point_x), float(camera.principal_point_y))
        return Camera(self.size, focal, (centre[0] - PIXEL_CENTRE, centre[1] - PIXEL_CENTRE))

    def to_pinhole(self, xy: np.ndarray) -> np.ndarray:
        """Return where the pinhole camera has positions (N, 2) of the image."""
        if not self.distorts or not len(xy):
            return xy
        pinhole = self.pinhole
        rays = self.colmap_camera().cam_from_img(np.ascontiguousarray(xy + PIXEL_CENTRE))
        return np.asarray(rays * pinhole.focal_px + np.array(pinhole.centre))

    def from_pinhole(self, xy: np.ndarray) -> np.ndarray:
        """Return where the image has positions (N, 2) of the pinhole camera."""
        if not self.distorts or not len(xy):
            return xy
        found = self.colmap_camera().img_from_cam(self.pinhole.rays(xy))
        return np.asarray(found - PIXEL_CENTRE)

    def undistort(self, image: np.ndarray) -> np.ndarray:
        """Return an image (H, W) or (H, W, 3) as the pinhole camera would have taken it."""
        if not self.distorts:
            return image
        width, height = self.size
        y, x = np.indices((height, width))
        places = self.from_pinhole(np.column_stack([x.ravel(), y.ravel()]).astype(np.float64))
        column, row = places.T.astype(np.float32).reshape(2, height, width)
        return cv2.remap(image, column, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT)


def known_cameras(
    calibration: Camera | Calibration | str | Path, sizes: Mapping[str, tuple[int, int]]
) -> dict[str, Camera]:
    """Return the cameras of the images, by name, that have the size of a calibration.

    Raises:
        ReconstructionError: it is wrong, or for none of them.
    """
    known: dict[str, Camera] = {}
    problem: ReconstructionError | None = None
    for name, size in sizes.items():
        try:
            if isinstance(calibration, (str, Path)):
                camera = read_calibration(calibration, size, size).camera0
            else:
                camera = calibration if isinstance(calibration, Camera) else calibration.camera0
                Calibration(camera, camera).check_sizes(size, size)
            known[name] = camera
        except ReconstructionError as error:
            problem = error
    if problem is not None and not known:
        raise problem
    return known


def initial_intrinsics(
    folder: Path,
    sizes: Mapping[str, tuple[int, int]],
    known: Mapping[str, Camera] = {},
    focal_px: float | None = None,
    single_camera: bool | None = None,
) -> dict[str, CameraIntrinsics]:
    """Return the known intrinsics of each image, or where their estimation begins.

    Args:
        folder: of the images, whose EXIF is read.
        sizes: (width, height) by the name of the image.
        known: cameras that are known, by name.
        focal_px: of the others; None: of their EXIF, or a guess.
        single_camera: as of `MultiViewOptions`; images that share a camera get the same object.
    """
    shared: dict[Any, CameraIntrinsics] = {}
    intrinsics = {}
    for name, size in sizes.items():
        if name in known:
            begin = CameraIntrinsics.of_camera(known[name])
        elif focal_px is not None:
            focal = Camera(size, focal_px).focal_px[0]
            begin = CameraIntrinsics.initial(size, focal, "focal_px")
        else:
            try:
                exif = camera_from_exif(folder / name, size)
                begin = CameraIntrinsics.initial(size, float(np.mean(exif.focal_px)))
            except ReconstructionError:
                begin = CameraIntrinsics.initial(size)
        key = {None: begin, True: size, False: name}[single_camera]
        intrinsics[name] = shared.setdefault(key, begin)
    return intrinsics
