"""Use COLMAP's camera models, and write its database, through pycolmap.

For a keypoint, OpenCV stores the diameter and the orientation in degrees. COLMAP stores half of the
diameter as the scale, and the orientation in radians. Both measure orientations clockwise.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import ReconstructionError
from .._shared.machine import temporarily
from .._shared.opencv import cv2
from .._shared.opencv import import_pycolmap as import_pycolmap
from ..batch.extraction import ROOT_SIFT_NORM
from ..batch.pair_list import Pair
from ..features.keypoints import UNSET_ANGLE, Keypoints
from ..features.learned import is_learned
from ..geometry.camera import Calibration, Camera
from ..io.exif import camera_from_exif

PIXEL_CENTRE, SIFT_NUMBERS = 0.5, 128
"""The centre of the upper left pixel is (0.5, 0.5) in COLMAP and (0, 0) in this package. A
descriptor in COLMAP's database has `SIFT_NUMBERS` numbers."""

CENTRE_TOLERANCE_PX, ROWS = 1e-6, 256
"""`CENTRE_TOLERANCE_PX` absorbs rounding errors before side lengths are rounded down to whole
pixels. An image is undistorted in strips of `ROWS` rows, which limits the memory needed."""

ESTIMATED_FOCAL_FACTOR = 1.2
"""An unknown focal length is guessed as this multiple of the image's longer side, as in COLMAP."""


@contextmanager
def quiet_pycolmap() -> Iterator[Any]:
    """Return pycolmap with its log switched off inside the `with` block."""
    pycolmap = import_pycolmap()
    with temporarily(pycolmap.logging, minloglevel=int(pycolmap.logging.FATAL)):
        yield pycolmap


@dataclass(frozen=True)
class CameraIntrinsics:
    """One of COLMAP's camera models with its parameters.

    Attributes:
        model: name, such as "PINHOLE" or "SIMPLE_RADIAL".
        size: (width, height) in pixels.
        params: parameters in COLMAP's order: focal lengths, principal point, then distortion. The
            principal point is in pixels with the centre of the first pixel at (0.5, 0.5).
        source: where the focal length comes from: "given" (by a calibration), "focal_px" (by the
            option of that name), "EXIF", or "estimated" (from a guess).
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
        """Return initial intrinsics with one radial distortion parameter. The mapping refines them.

        Without `focal_px`, the focal length is guessed, and the source is "estimated".
        """
        if focal_px is None:
            focal_px, source = ESTIMATED_FOCAL_FACTOR * max(size), "estimated"
        return cls("SIMPLE_RADIAL", size, (focal_px, size[0] / 2, size[1] / 2, 0.0), source)

    @classmethod
    def of_colmap(cls, camera: Any, source: str = "given") -> CameraIntrinsics:
        """Return the intrinsics of a `pycolmap.Camera`."""
        size = (int(camera.width), int(camera.height))
        return cls(camera.model_name, size, tuple(map(float, camera.params)), source)

    def colmap_camera(self) -> Any:
        """Return these intrinsics as a `pycolmap.Camera`."""
        pycolmap = import_pycolmap()
        camera = pycolmap.Camera(
            model=self.model, width=self.size[0], height=self.size[1], params=list(self.params)
        )
        camera.has_prior_focal_length = self.source != "estimated"
        return camera

    @property
    def distorts(self) -> bool:
        """Whether the camera model has distortion parameters, unlike a pinhole model."""
        return self.model not in ("PINHOLE", "SIMPLE_PINHOLE")

    @property
    def pinhole(self) -> Camera:
        """The pinhole camera with the same focal lengths and principal point."""
        camera = self.colmap_camera()
        focal = (float(camera.focal_length_x), float(camera.focal_length_y))
        centre = (float(camera.principal_point_x), float(camera.principal_point_y))
        return Camera(self.size, focal, (centre[0] - PIXEL_CENTRE, centre[1] - PIXEL_CENTRE))

    def to_pinhole(self, xy: np.ndarray) -> np.ndarray:
        """Map (N, 2) pixels of the distorted image to undistorted pixels of `pinhole`."""
        if not self.distorts or not len(xy):
            return xy
        pinhole = self.pinhole
        rays = self.colmap_camera().cam_from_img(np.ascontiguousarray(xy + PIXEL_CENTRE))
        return np.asarray(rays * pinhole.focal_px + np.array(pinhole.centre))

    def from_pinhole(self, xy: np.ndarray) -> np.ndarray:
        """Map (N, 2) undistorted pixels of `pinhole` to pixels of the distorted image."""
        if not self.distorts or not len(xy):
            return xy
        found = self.colmap_camera().img_from_cam(self.pinhole.rays(xy))
        return np.asarray(found - PIXEL_CENTRE)

    @property
    def without_border(self) -> CameraIntrinsics:
        """Pinhole intrinsics of the undistorted image, cropped so that it has no empty border."""
        pycolmap = import_pycolmap()
        cropped = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), self.colmap_camera())
        return CameraIntrinsics.of_colmap(cropped, self.source) if self.distorts else self

    @property
    def centred(self) -> CameraIntrinsics:
        """`without_border`, cropped further so that the principal point is in the middle.

        Raises a ReconstructionError if the principal point lies outside the image.
        """
        pinhole = self.without_border.pinhole
        middle = np.add(pinhole.centre, PIXEL_CENTRE)
        side = 2 * np.minimum(middle, np.subtract(pinhole.size, middle))
        if side.min() < 1:
            raise ReconstructionError(
                f"the principal point {pinhole.centre} lies outside the image, so no crop has it "
                "in the middle: correct the calibration, or leave out the format 'splat'"
            )
        camera = Camera(np.floor(side + CENTRE_TOLERANCE_PX).tolist(), pinhole.focal_px)
        return replace(CameraIntrinsics.of_camera(camera), source=self.source)

    def undistort(self, image: np.ndarray, pinhole: Camera | None = None) -> np.ndarray:
        """Undistort an image, (H, W) or (H, W, 3), taken by this camera.

        The result is what `pinhole` (default: `self.pinhole`) sees. `image` may be a scaled copy.
        """
        if not self.distorts and (pinhole is None or pinhole.size == image.shape[1::-1]):
            return image
        pinhole, camera = pinhole or self.pinhole, self.colmap_camera()
        ratio = np.divide(image.shape[1::-1], self.size)
        width, height = pinhole.size
        made = np.empty((height, width, *image.shape[2:]), image.dtype)
        for top in range(0, height, ROWS):
            part = made[top : top + ROWS]
            y, x = np.indices(part.shape[:2], np.float64)
            rays = pinhole.rays(np.column_stack([x.ravel(), y.ravel() + top]))
            places = camera.img_from_cam(rays) * ratio - PIXEL_CENTRE
            column, row = places.T.astype(np.float32).reshape(2, *part.shape[:2])
            part[:] = cv2.remap(image, column, row, cv2.INTER_LANCZOS4, borderValue=0)
        return made


def known_cameras(
    calibration: Camera | Calibration | str | Path, sizes: Mapping[str, tuple[int, int]]
) -> dict[str, Camera]:
    """Return, by image name, the calibrated camera of each image whose size the calibration fits.

    Raises a ReconstructionError if the calibration is invalid, or fits no image.
    """
    known: dict[tuple[int, int], Camera] = {}
    problem: ReconstructionError | None = None
    for size in dict.fromkeys(sizes.values()):
        try:
            if isinstance(calibration, (str, Path)):
                camera = Calibration.load(calibration, size).camera0
            else:
                camera = calibration if isinstance(calibration, Camera) else calibration.camera0
                Calibration(camera, camera).check_sizes(size, size)
            known[size] = camera
        except ReconstructionError as error:
            problem = error
    if problem is not None and not known:
        raise problem
    return {name: known[size] for name, size in sizes.items() if size in known}


def initial_intrinsics(
    folder: Path,
    sizes: Mapping[str, tuple[int, int]],
    known: Mapping[str, Camera] = {},
    focal_px: float | None = None,
    single_camera: bool | None = None,
) -> dict[str, CameraIntrinsics]:
    """Return the intrinsics of each image: those in `known`, or initial values to be refined.

    The initial focal length is `focal_px` if given, else that of EXIF, else a guess. Images that
    share a camera (see `MultiViewOptions`) get the same object.
    """
    begins = {}
    for name, size in sizes.items():
        if name in known:
            begins[name] = CameraIntrinsics.of_camera(known[name])
        elif focal_px is not None:
            focal = Camera(size, focal_px).focal_px[0]
            begins[name] = CameraIntrinsics.initial(size, focal, "focal_px")
        else:
            try:
                exif = camera_from_exif(folder / name, size)
                begins[name] = CameraIntrinsics.initial(size, float(np.mean(exif.focal_px)))
            except ReconstructionError:
                begins[name] = CameraIntrinsics.initial(size)
    shared: dict[Any, CameraIntrinsics] = {}
    keys = {
        name: {None: begin, True: begin.size, False: name}[single_camera]
        for name, begin in begins.items()
    }
    # Guessed focal lengths come last, so a shared camera prefers a focal length from EXIF.
    for name in sorted(begins, key=lambda name: begins[name].source == "estimated"):
        shared.setdefault(keys[name], begins[name])
    return {name: shared[keys[name]] for name in sizes}


def write_database(
    path: Path,
    images: Mapping[str, tuple[Keypoints, CameraIntrinsics]],
    matches: Mapping[Pair, np.ndarray],
) -> None:
    """Write a new COLMAP database to a file that does not exist or is empty.

    Images with the same intrinsics object share a camera. Keypoints without sizes are written
    without scale and orientation. `matches` maps each pair of images to (K, 2) keypoint indices.
    """
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(path) as database:
        cameras: dict[int, tuple[int, int]] = {}  # camera ID and rig ID, by `id` of the intrinsics
        numbers: dict[str, int] = {}
        for name, (points, intrinsics) in images.items():
            if id(intrinsics) not in cameras:
                camera = intrinsics.colmap_camera()
                camera.camera_id = database.write_camera(camera)
                rig = pycolmap.Rig()
                rig.add_ref_sensor(camera.sensor_id)
                cameras[id(intrinsics)] = camera.camera_id, database.write_rig(rig)
            camera_id, rig_id = cameras[id(intrinsics)]
            row = pycolmap.Image(name=name, camera_id=camera_id)
            row.image_id = numbers[name] = database.write_image(row)
            frame = pycolmap.Frame()
            frame.rig_id = rig_id
            frame.add_data_id(row.data_id)
            database.write_frame(frame)
            columns = [points.xy + PIXEL_CENTRE]
            if points.sizes is not None:
                columns += [points.sizes[:, None] / 2, orientations_of(points)[:, None]]
            keypoints = np.ascontiguousarray(np.hstack(columns), np.float32)
            database.write_keypoints(row.image_id, keypoints)
            descriptors = sift_bytes(points)
            if descriptors is not None:
                described = pycolmap.FeatureDescriptors(
                    pycolmap.FeatureExtractorType.SIFT, np.ascontiguousarray(descriptors)
                )
                database.write_descriptors(row.image_id, described)
        for (name0, name1), rows in matches.items():
            found = np.ascontiguousarray(rows, np.uint32).reshape(-1, 2)
            database.write_matches(numbers[name0], numbers[name1], found)


def orientations_of(points: Keypoints) -> np.ndarray:
    """Return (N,) orientations in radians, clockwise. Keypoints without an orientation get 0."""
    if points.angles is None:
        return np.zeros(len(points), np.float32)
    return np.deg2rad(np.where(points.angles == UNSET_ANGLE, 0, points.angles))


def sift_bytes(keypoints: Keypoints) -> np.ndarray | None:
    """Convert descriptors to SIFT's format, (N, 128) uint8. Return None if this is impossible.

    A learned descriptor of 64 signed numbers becomes its 64 positive and its 64 negative parts.
    Unit vectors are multiplied by 512 as in SIFT: rounding loses 1 to 2 % of the correct matches.
    """
    found = keypoints.descriptors
    if found is not None and is_learned(keypoints.descriptor_type):
        found = np.hstack([np.maximum(found, 0), np.maximum(-found, 0)])
    if found is None or found.shape[1] != SIFT_NUMBERS:
        return None
    if found.dtype == np.uint8:
        return found
    if found.size and found.min() < 0:
        return None
    return np.rint(found * ROOT_SIFT_NORM).clip(0, 255).astype(np.uint8)
