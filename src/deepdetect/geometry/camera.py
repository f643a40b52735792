"""Pinhole cameras, calibrations of stereo pairs, and images with a known camera pose.

The package's own camera file, such as calib.json, is one JSON object. Only `focal_px` is required.
Focal lengths and positions are in pixels, and the centre of the first pixel is (0, 0)::

    {"focal_px": 1246.7,            focal length: one number, or [fx, fy]
     "cx": 231.0, "cy": 184.5,      principal point; default: the middle of the image
     "width": 463, "height": 370,   size of the images; if missing, it is not checked
     "baseline_mm": 160.0,          distance between the cameras; default: unknown
     "disparity_offset_px": 66.7,   cx right minus cx left; default: computed from the values of cx
     "left": {...}, "right": {...}} values for one view only: focal_px, cx, cy, width, height

Without `baseline_mm`, lengths are in multiples of the baseline. An unknown key with a number other
than 0 is an error, because it may be a lens distortion. Unknown texts and objects are ignored.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.atomic import write_whole
from .._shared.errors import MissingCalibrationError, ReconstructionError, first_line
from .._shared.options import numbers_of, shown, suggest_keywords
from .camera_files import read_camera_file
from .transforms import outer_corners

Size = tuple[int, int]

MAX_OFFSET_ERROR_PX = 0.5
"""Maximum difference of `disparity_offset_px` from cx right - cx left, in px. Chosen by hand."""


@suggest_keywords
@dataclass(frozen=True, init=False)
class Camera:
    """A pinhole camera.

    Args:
        size: (width, height) of the image in pixels.
        focal_px: focal length in pixels, one number or (fx, fy).
        centre: principal point (cx, cy) in pixels. None means the middle of the image.

    Attributes:
        size, focal_px, centre: the values of the arguments, each as a pair.

    Raises:
        ReconstructionError: a value is not finite or not positive.

    Example:
        >>> Camera((640, 480), 500.0)
        Camera(size=(640, 480), focal_px=(500.0, 500.0), centre=(319.5, 239.5))
    """

    size: Size
    focal_px: tuple[float, float]
    centre: tuple[float, float]

    def __init__(
        self,
        size: Sequence[float],
        focal_px: float | Sequence[float],
        centre: Sequence[float] | None = None,
    ) -> None:
        width, height = _numbers("the image size", size, 2)
        if min(width, height) < 1:
            raise ReconstructionError(f"an image size must be positive, not {size}")
        focal = _numbers("the focal length", focal_px, 2)
        if min(focal) <= 0:
            raise ReconstructionError(
                f"the focal length must be above 0 pixels, not {min(focal):g}"
            )
        if centre is None:
            centre = (width - 1) / 2, (height - 1) / 2
        object.__setattr__(self, "size", (int(width), int(height)))
        object.__setattr__(self, "focal_px", focal)
        object.__setattr__(self, "centre", _numbers("the principal point", centre, 2))

    @property
    def matrix(self) -> np.ndarray:
        """The (3, 3) matrix of intrinsics, with focal lengths and principal point."""
        (fx, fy), (cx, cy) = self.focal_px, self.centre
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])

    def scaled(self, size: Size) -> Camera:
        """Return the camera for the same image scaled to another (width, height)."""
        ratio = np.divide(_numbers("the image size", size, 2), self.size)
        centre = (np.array(self.centre) + 0.5) * ratio - 0.5
        return Camera(size, (ratio * self.focal_px).tolist(), centre.tolist())

    def rays(self, points: np.ndarray) -> np.ndarray:
        """Return the (N, 3) rays (x, y, 1) through (N, 2) pixels, in the camera's frame."""
        points = numbers_of("points", points, np.float64, 2)
        directions = np.ones((len(points), 3))
        directions[:, :2] = (points - self.centre) / self.focal_px
        return directions

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project (N, 3) points in the camera's frame (y down, z forward) to (N, 2) pixels."""
        points = numbers_of("points", points, np.float64, 3)
        with np.errstate(divide="ignore", invalid="ignore"):
            return points[:, :2] / points[:, 2:] * self.focal_px + self.centre


@suggest_keywords
@dataclass(frozen=True)
class Calibration:
    """The two cameras of a stereo pair and, if it is known, the distance between them.

    Attributes:
        camera0, camera1: cameras of the left (first) and the right (second) image.
        baseline_mm: distance between the camera centres. If None, depths are in baselines.
        source: where the calibration comes from, such as "calib.json", "focal_px" or "EXIF".

    Raises:
        ReconstructionError: the baseline is not above 0.

    Example:
        >>> left, right = Camera((463, 370), 1246.7), Camera((463, 370), 1246.7, (297.7, 184.5))
        >>> calibration = Calibration(left, right, baseline_mm=160)
        >>> round(calibration.disparity_offset_px, 1), calibration.depth_mm(np.array([40])).round()
        (66.7, array([1869.]))
    """

    camera0: Camera
    camera1: Camera
    baseline_mm: float | None = None
    source: str = "given"

    def __post_init__(self) -> None:
        if self.baseline_mm is None:
            return
        (baseline,) = _numbers("the baseline", self.baseline_mm, 1)
        if baseline <= 0:
            raise ReconstructionError(
                f"the baseline must be above 0 mm, not {baseline:g}: two images from one place "
                "have no depth; give the distance between the cameras, or leave the baseline out"
            )
        object.__setattr__(self, "baseline_mm", baseline)

    @property
    def disparity_offset_px(self) -> float:
        """The offset cx right minus cx left in pixels, which `depth_mm` adds to each disparity."""
        return self.camera1.centre[0] - self.camera0.centre[0]

    def depth_mm(self, disparity_px: np.ndarray) -> np.ndarray:
        """Return the depths that belong to disparities of a rectified pair.

        depth = focal length * baseline / (disparity + `disparity_offset_px`). Depths are in mm, or
        in baselines if `baseline_mm` is None.

        Args:
            disparity_px: x in the left image minus x in the right image, an array of any shape.

        Returns:
            float64 depths of the same shape; infinite where disparity + offset is not positive.
        """
        moved = numbers_of("disparity_px", disparity_px, np.float64) + self.disparity_offset_px
        baseline = 1.0 if self.baseline_mm is None else self.baseline_mm
        with np.errstate(divide="ignore"):
            depth = self.camera0.focal_px[0] * baseline / moved
        return np.where(moved > 0, depth, np.inf)

    @classmethod
    @suggest_keywords
    def load(
        cls,
        path: str | Path,
        size0: Size | None = None,
        size1: Size | None = None,
        *,
        views: tuple[int, int] | None = None,
    ) -> Calibration:
        """Read a camera file: JSON of this package, or a file of OpenCV, ROS, Kalibr and others.

        The format is recognised by the content. The formats are listed in docs/files.md of
        https://github.com/deepdetect/deepdetect.

        Args:
            path: a file, or a folder with one file for each of the two cameras.
            size0, size1: (width, height) of the images. None takes the size from the file.
            views: numbers of the left and the right camera in a KITTI file. None takes the colour
                cameras 2 and 3, or the grey ones 0 and 1 if there are no others.

        Raises:
            ReconstructionError: the file is missing, damaged, contradictory or of an unknown
                format, its cameras have lens distortion, or it is for images of another size.
        """
        with _reading(path):
            values = read_camera_file(Path(path), size0 and (size0[0], size0[1]), views)
            return _calibration(values, size0, size1, str(path))

    def save(self, path: str | Path) -> None:
        """Write the package's own camera file, from which `load` reads the same cameras.

        Example:
            >>> import tempfile
            >>> path = Path(tempfile.mkdtemp()) / "calib.json"
            >>> Calibration(Camera((640, 480), 500), Camera((640, 480), 500), 120).save(path)
            >>> Calibration.load(path).baseline_mm
            120.0
        """
        values: dict[str, Any] = {"baseline_mm": self.baseline_mm}
        for side, camera in (("left", self.camera0), ("right", self.camera1)):
            (cx, cy), (width, height) = camera.centre, camera.size
            values[side] = {"focal_px": camera.focal_px, "cx": cx, "cy": cy}
            values[side] |= {"width": width, "height": height}
        write_whole(path, json.dumps(values, indent=1) + "\n")

    def check_sizes(self, size0: Size, size1: Size) -> None:
        """Raise a `ReconstructionError` unless the calibration is for images of these sizes."""
        for name, camera, size in (("left", self.camera0, size0), ("right", self.camera1, size1)):
            if camera.size != (other := _numbers("the image size", size, 2)):
                wanted, actual = (f"{side[0]:g}x{side[1]:g}" for side in (camera.size, other))
                raise ReconstructionError(
                    f"the calibration is for images of {wanted} pixels, but the {name} image has "
                    f"{actual}: give a calibration for this size"
                )


def check_camera_file(path: str | Path) -> None:
    """Raise a ReconstructionError if a camera file cannot be read; image sizes are not checked."""
    with _reading(path):
        read_camera_file(Path(path))


@contextmanager
def _reading(path: str | Path) -> Iterator[None]:
    try:
        yield
    except ReconstructionError as error:
        raise ReconstructionError(f"{path}: {error}") from None
    except OSError as error:
        missing = isinstance(error, FileNotFoundError)
        kind = MissingCalibrationError if missing else ReconstructionError
        raise kind(f"{path} cannot be read ({error.strerror}): check the path") from None
    except Exception as error:  # the readers of camera files raise exceptions of many types
        raise ReconstructionError(
            f"{path} is damaged ({first_line(error)}): correct it, or give the focal length"
        ) from None


def _calibration(
    values: dict[str, Any], size0: Size | None, size1: Size | None, source: str
) -> Calibration:
    views = []
    for name in ("left", "right"):
        of_view = values.get(name, {})
        if not isinstance(of_view, dict):
            raise ReconstructionError(f'"{name}" must be a JSON object, such as {{"cx": 320}}')
        together = {**values, **of_view}
        views.append({key: value for key, value in together.items() if value is not None})
    left, right = views
    size0 = size0 or _size_of(left)
    size1 = size1 or (_size_of(right) if {"width", "height"} <= {*right} else size0)
    camera0 = _camera(left, size0)
    offset = values.get("disparity_offset_px")
    if offset is not None:
        (offset,) = _numbers("disparity_offset_px", offset, 1)
        if "cx" not in values.get("right", {}):
            right["cx"] = camera0.centre[0] + offset
    calibration = Calibration(camera0, _camera(right, size1), values.get("baseline_mm"), source)
    measured = calibration.disparity_offset_px
    if offset is not None and abs(measured - offset) > MAX_OFFSET_ERROR_PX:
        raise ReconstructionError(
            f"disparity_offset_px is {offset:g}, but cx of the right view minus cx of the left "
            f"is {measured:g}: leave out `disparity_offset_px`, or correct it"
        )
    try:
        calibration.check_sizes(size0, size1)
    except ReconstructionError as error:
        whose = values.get("format", "the calibration")
        raise ReconstructionError(str(error).replace("the calibration", whose, 1)) from None
    return calibration


def _size_of(view: dict[str, Any]) -> Size:
    if not {"width", "height"} <= {*view}:
        raise ReconstructionError("it does not contain the size of the images: give `size0`")
    return view["width"], view["height"]


def _camera(view: dict[str, Any], size: Size) -> Camera:
    if "focal_px" not in view:
        raise ReconstructionError('it has no "focal_px": add the focal length in pixels')
    size = view.get("width", size[0]), view.get("height", size[1])
    camera = Camera(size, view["focal_px"])
    centre = view.get("cx", camera.centre[0]), view.get("cy", camera.centre[1])
    return replace(camera, centre=centre)


def _numbers(name: str, value: Any, count: int) -> tuple[float, ...]:
    """Return a value as a tuple of `count` finite numbers; a single number is repeated."""
    try:
        numbers = np.broadcast_to(value, count).astype(np.float64, casting="same_kind")
    except (TypeError, ValueError):
        numbers = np.full(count, np.nan)
    if not np.isfinite(numbers).all():
        wanted = "a finite number" if count == 1 else "one or two finite numbers"
        raise ReconstructionError(f"{name} must be {wanted}, not {shown(value)}")
    return tuple(numbers.tolist())


def fundamental_matrix(
    calibration: Calibration, rotation: np.ndarray, translation: np.ndarray
) -> np.ndarray:
    """Return the (3, 3) F of the pose X1 = rotation @ X0 + translation; x1^T F x0 = 0 in pixels."""
    essential = cross_matrix(translation) @ rotation
    inverse0 = np.linalg.inv(calibration.camera0.matrix)
    return np.linalg.inv(calibration.camera1.matrix).T @ essential @ inverse0


def cross_matrix(vector: np.ndarray) -> np.ndarray:
    """Return the (3, 3) matrix M for which M @ v is the cross product of `vector` and v."""
    x, y, z = np.asarray(vector, np.float64).reshape(3)
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def angles_between(vectors0: np.ndarray, vectors1: np.ndarray) -> np.ndarray:
    """Return the (N,) angles in radians between (N, 3) vectors; small angles are also accurate."""
    across = np.linalg.norm(np.cross(vectors0, vectors1), axis=1)
    return np.asarray(np.arctan2(across, np.einsum("ij,ij->i", vectors0, vectors1)))


@dataclass(frozen=True, eq=False)
class PosedView:
    """An image with a known camera pose.

    Attributes:
        name: name of the image.
        camera: its pinhole camera; the centre of the first pixel is (0, 0).
        rotation, translation: (3, 3) and (3,) float64. A point X of the world has the coordinates
            rotation @ X + translation in the camera's frame (x right, y down, z forward).
    """

    name: str
    camera: Camera
    rotation: np.ndarray
    translation: np.ndarray

    @property
    def centre(self) -> np.ndarray:
        """Position of the camera in the world, (3,) float64."""
        return np.asarray(-self.rotation.T @ self.translation)

    def relative_to(self, first: PosedView) -> PosedView:
        """Return this view with the camera frame of the view `first` as the world frame."""
        rotation = self.rotation @ first.rotation.T
        return replace(
            self, rotation=rotation, translation=self.translation - rotation @ first.translation
        )

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project (N, 3) points of the world; return (N, 2) pixel positions and (N,) depths."""
        seen = np.asarray(points, np.float64) @ self.rotation.T + self.translation
        return self.camera.project(seen), seen[:, 2]

    def corners(self, depth: float) -> np.ndarray:
        """Return the corners of the field of view at a depth, (4, 3) in the frame of the world."""
        rays = self.camera.rays(outer_corners(self.camera.size)) * depth
        return np.asarray((rays - self.translation) @ self.rotation)


def camera_spacing(centres: np.ndarray) -> float:
    """Return the median distance from a camera to its nearest neighbour; `centres` is (V, 3)."""
    blocks = np.array_split(centres, len(centres) // 500 + 1)  # blocks, to save memory
    distances = (np.linalg.norm(block[:, None] - centres, axis=2) for block in blocks)
    second = min(1, len(centres) - 1)  # index 0 is the camera itself
    nearest = [np.partition(each, second, axis=1)[:, second] for each in distances]
    return float(np.median(np.concatenate(nearest)))
