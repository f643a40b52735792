"""Cameras with distortion, as COLMAP models them, and the photographs without it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .._shared.opencv import cv2
from ..geometry.camera import Camera
from .colmap import PIXEL_CENTRE, import_pycolmap

ESTIMATED_FOCAL_FACTOR = 1.2
"""Focal length over the longer side, where nothing is known: where its estimation begins."""


@dataclass(frozen=True)
class Lens:
    """One of COLMAP's camera models with its parameters; focal lengths and centre come first.

    Attributes:
        model: name, as "PINHOLE" or "SIMPLE_RADIAL".
        size: (width, height) in pixels.
        params: as COLMAP has them, where the centre of the first pixel is (0.5, 0.5).
        source: where they come from: "given", "EXIF", or "estimated".
    """

    model: str
    size: tuple[int, int]
    params: tuple[float, ...]
    source: str = "given"

    @classmethod
    def of_camera(cls, camera: Camera) -> Lens:
        """Return the lens of a known pinhole camera.

        Example:
            >>> Lens.of_camera(Camera((640, 480), 500.0)).params
            (500.0, 500.0, 320.0, 240.0)
        """
        centre = (camera.centre[0] + PIXEL_CENTRE, camera.centre[1] + PIXEL_CENTRE)
        return cls("PINHOLE", camera.size, (*camera.focal_px, *centre))

    @classmethod
    def initial(cls, size: tuple[int, int], focal_px: float | None = None) -> Lens:
        """Return a lens to be estimated, with one parameter of radial distortion.

        Args:
            size: (width, height) in pixels.
            focal_px: of EXIF; None where it is not known.

        Example:
            >>> Lens.initial((1000, 500)).params
            (1200.0, 500.0, 250.0, 0.0)
        """
        source = "estimated" if focal_px is None else "EXIF"
        focal = ESTIMATED_FOCAL_FACTOR * max(size) if focal_px is None else focal_px
        return cls("SIMPLE_RADIAL", size, (focal, size[0] / 2, size[1] / 2, 0.0), source)

    @classmethod
    def of_colmap(cls, camera: Any, source: str = "given") -> Lens:
        """Return the lens of a camera of pycolmap."""
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
        """Whether its photographs differ from those of a pinhole camera."""
        return self.model not in ("PINHOLE", "SIMPLE_PINHOLE")

    @property
    def pinhole(self) -> Camera:
        """The camera without the distortion."""
        camera = self.colmap_camera()
        focal = (float(camera.focal_length_x), float(camera.focal_length_y))
        centre = (float(camera.principal_point_x), float(camera.principal_point_y))
        return Camera(self.size, focal, (centre[0] - PIXEL_CENTRE, centre[1] - PIXEL_CENTRE))

    def to_pinhole(self, xy: np.ndarray) -> np.ndarray:
        """Return where the pinhole camera has positions (N, 2) of the photograph."""
        xy = np.asarray(xy, np.float64).reshape(-1, 2)
        if not self.distorts or not len(xy):
            return xy
        pinhole = self.pinhole
        rays = self.colmap_camera().cam_from_img(np.ascontiguousarray(xy + PIXEL_CENTRE))
        return np.asarray(rays * pinhole.focal_px + np.array(pinhole.centre))

    def from_pinhole(self, xy: np.ndarray) -> np.ndarray:
        """Return where the photograph has positions (N, 2) of the pinhole camera."""
        xy = np.asarray(xy, np.float64).reshape(-1, 2)
        if not self.distorts or not len(xy):
            return xy
        found = self.colmap_camera().img_from_cam(self.pinhole.rays(xy))
        return np.asarray(found - PIXEL_CENTRE)

    def undistort(self, image: np.ndarray) -> np.ndarray:
        """Return a photograph (H, W) or (H, W, 3) as the pinhole camera would have taken it."""
        if not self.distorts:
            return image
        width, height = self.size
        y, x = np.indices((height, width))
        places = self.from_pinhole(np.column_stack([x.ravel(), y.ravel()]).astype(np.float64))
        column, row = places.T.astype(np.float32).reshape(2, height, width)
        return cv2.remap(image, column, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT)
