"""Read folders of images with known cameras, in three public layouts, or with GPS positions.

- Strecha et al. (2008): NNNN.jpg or .png with NNNN.camera (or NNNN.jpg.camera).
- KITTI odometry (Geiger et al., 2012): NNNNNN.png or .jpg with calib.txt or K.txt, and with
  poses.txt. The first line of calib.txt holds the projection matrix of the camera. K.txt holds its
  camera matrix. Line 1 of poses.txt belongs to image 000000.
- COLMAP (Schönberger and Frahm, 2016): a text or binary model without distortion in the folder, in
  sparse/ or in sparse/0/, and images in the folder or in images/. pycolmap reads the model. After
  undistortion cameras may keep the name of a lens model, such as OPENCV, with coefficients of 0.

Intrinsics are in pixels of the image files. They are scaled if they are given for another size.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from deepdetect._shared.errors import ImageError, first_line
from deepdetect._shared.opencv import import_pycolmap
from deepdetect.geometry.camera import Calibration, Camera, PosedView, fundamental_matrix
from deepdetect.io.gps import read_gps
from deepdetect.io.image import UPRIGHT, orientation_of
from deepdetect.io.image_file import open_image
from deepdetect.sfm.georeference import Origin

from .pair_selection import FRAME_DISTANCES, sequence_pairs, unordered_pairs

SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".PNG")

MAX_ROTATION_ERROR = 1e-3
"""Tolerance for R R^T = I in rotation matrices R from files with few digits. Chosen by hand."""

MAX_ASPECT_ERROR = 0.01
"""Aspect ratios of image and camera may differ by this fraction (rounding). Chosen by hand."""

COLMAP_FILES = ("images.bin", "images.txt")


@dataclass(frozen=True, eq=False)
class PosedImage(PosedView):
    """An image file and its camera. `name` is the file's name; lengths are in the scene's unit."""

    path: Path


@dataclass(frozen=True, eq=False)
class PosedPair:
    """Two images of a scene.

    `frame_distance` is the number of frames from the first to the second image of a sequence. It is
    None for unordered images.
    """

    scene: str
    first: PosedImage
    second: PosedImage
    frame_distance: int | None = None

    @property
    def name(self) -> str:
        """Name of the pair, for example "fountain 0000-0005"."""
        return f"{self.scene} {self.first.path.stem}-{self.second.path.stem}"

    @property
    def rotation(self) -> np.ndarray:
        """The (3, 3) relative rotation: X_second = rotation @ X_first + translation."""
        return self.second.relative_to(self.first).rotation

    @property
    def translation(self) -> np.ndarray:
        """The (3,) relative translation, in the scene's unit of length."""
        return self.second.relative_to(self.first).translation

    @property
    def fundamental(self) -> np.ndarray:
        """The (3, 3) fundamental matrix F: x1^T F x0 = 0 for pixels x0 (first) and x1 (second)."""
        cameras = Calibration(self.first.camera, self.second.camera)
        return fundamental_matrix(cameras, self.rotation, self.translation)


@dataclass(frozen=True, eq=False)
class PosedScene:
    """The images of a scene, their cameras, and the pairs chosen for matching.

    Attributes:
        name: name of the folder.
        images: all images, sorted by name.
        pairs: the chosen pairs.
        located_only: whether only camera positions are known, in metres, from GPS. If so, the
            intrinsics and rotations are meaningless, and there are no pairs.
    """

    name: str
    images: tuple[PosedImage, ...]
    pairs: tuple[PosedPair, ...]
    located_only: bool = False


def load_posed_scenes(
    folder: str | Path, max_pairs: int = 60, located: bool = False
) -> list[PosedScene]:
    """Read a folder as one scene, or each of its subfolders as a scene.

    Args:
        folder: a scene in one of the three layouts, or a folder of scenes.
        max_pairs: at most this number of pairs are chosen in a scene. Pairs of unordered images are
            evenly spaced. A sequence has equally many pairs at each of `FRAME_DISTANCES`.
        located: also read folders without cameras whose first image has a GPS position.

    Raises:
        ImageError: there is no scene, or a file is missing or damaged.
    """
    root = Path(folder).resolve()
    below = sorted(path for path in root.iterdir() if path.is_dir()) if root.is_dir() else []
    folders = [root] if _reader(root, located) else below
    readers = {path: read for path in folders if (read := _reader(path, located)) is not None}
    if not readers:
        raise ImageError(
            f"there are no images with cameras in {folder}: it, or each of its folders, must hold "
            "NNNN.camera files (Strecha), calib.txt or K.txt and poses.txt (KITTI), or images.txt "
            "or images.bin (COLMAP)"
        )
    return [_load_scene(path, read, max_pairs) for path, read in readers.items()]


def _reader(folder: Path, located: bool) -> Callable[[Path], list[PosedImage]] | None:
    if any(folder.glob("*.camera")):
        return _read_strecha
    if (folder / "poses.txt").is_file() and _kitti_calibration(folder).is_file():
        return _read_kitti
    if _colmap_model(folder) is not None:
        return _read_colmap
    if located and folder.is_dir():
        first = min((path for path in folder.iterdir() if path.suffix in SUFFIXES), default=None)
        if first is not None and read_gps(first) is not None:
            return _read_located
    return None


def _load_scene(
    folder: Path, read: Callable[[Path], list[PosedImage]], max_pairs: int
) -> PosedScene:
    images, name = read(folder), folder.name
    if read is _read_located:
        return PosedScene(name, tuple(images), (), located_only=True)
    pairs = []
    distances = ""
    if read is _read_kitti:
        distances = f" at the frame distances {FRAME_DISTANCES}"
        of_frame = {int(image.path.stem): image for image in images}
        for a, b in sequence_pairs([*of_frame], max_pairs, FRAME_DISTANCES):
            pairs.append(PosedPair(name, of_frame[a], of_frame[b], b - a))
    elif len(images) > 1:
        for a, b in unordered_pairs(len(images), max_pairs):
            pairs.append(PosedPair(name, images[a], images[b]))
    if not pairs:
        raise ImageError(f"there are no two images with cameras{distances} in {folder}: add some")
    return PosedScene(name, tuple(images), tuple(pairs))


def _read_strecha(folder: Path) -> list[PosedImage]:
    """Read the .camera files of a folder.

    A file holds the camera matrix, a row of zeros, the camera's axes (columns of a matrix) and
    centre in the world, and the width and height of the image.
    """
    images = []
    for file in sorted(folder.glob("*.camera")):
        numbers = _numbers(_text(file).split(), 26, str(file))
        size = (numbers[24], numbers[25])
        stem = folder / file.name.removesuffix(".camera")
        found = [path for end in ("", *SUFFIXES) if (path := Path(f"{stem}{end}")).is_file()]
        if not found:
            raise ImageError(f"there is no image {stem}.jpg or .png for {file}: put it there")
        axes, centre = numbers[12:21].reshape(3, 3), numbers[21:24]
        pose = axes.T, -axes.T @ centre
        images.append(_posed_image(found[0], numbers[:9].reshape(3, 3), *pose, file, size))
    return images


def _kitti_calibration(folder: Path) -> Path:
    calibration = folder / "calib.txt"
    return calibration if calibration.is_file() else folder / "K.txt"


def _read_kitti(folder: Path) -> list[PosedImage]:
    calibration, poses = _kitti_calibration(folder), folder / "poses.txt"
    if calibration.name == "K.txt":
        matrix = _numbers(_text(calibration).split(), 9, str(calibration)).reshape(3, 3)
        projection = np.column_stack([matrix, np.zeros(3)])
    else:
        words = (_text(calibration).splitlines() or [""])[0].split()
        if words and words[0].endswith(":"):
            words = words[1:]
        projection = _numbers(words, 12, f"the first line of {calibration}").reshape(3, 4)
    lines = [line for line in _text(poses).splitlines() if line.strip()]
    images = []
    for path in sorted(folder.iterdir()):
        if path.suffix not in SUFFIXES or not path.stem.isdecimal():
            continue
        frame = int(path.stem)
        if frame >= len(lines):
            raise ImageError(
                f"{poses} has {len(lines)} lines and no pose for {path.name}: line 1 is for 000000"
            )
        where = f"line {frame + 1} of {poses}"
        pose = _numbers(lines[frame].split(), 12, where).reshape(3, 4)
        axes, centre = pose[:, :3], pose[:, 3]
        image = _posed_image(path, projection[:, :3], axes.T, -axes.T @ centre, where)
        # The poses are those of KITTI's first camera, but another camera may have taken the images.
        # The last column of the projection matrix gives the offset between these cameras.
        offset = np.linalg.solve(projection[:, :3], projection[:, 3])
        images.append(replace(image, translation=image.translation + offset))
    return images


def _colmap_model(folder: Path) -> Path | None:
    """Return the folder that holds a COLMAP model, or None if there is no model."""
    places = [folder, folder / "sparse", folder / "sparse" / "0"]
    return next((p for p in places if any((p / name).is_file() for name in COLMAP_FILES)), None)


def _read_colmap(folder: Path) -> list[PosedImage]:
    place = _colmap_model(folder) or folder
    try:
        model = import_pycolmap("COLMAP's model").Reconstruction(place)
    except (
        ValueError,
        IndexError,
        RuntimeError,
    ) as error:  # the type of error depends on the damage
        raise ImageError(
            f"{place} has no model that pycolmap can read ({first_line(error)}): write cameras, "
            "images and points3D with COLMAP"
        ) from None
    images = []
    for image in model.images.values():
        paths = [path for part in ("", "images") if (path := folder / part / image.name).is_file()]
        if not paths:
            raise ImageError(
                f"there is no image {image.name} in {folder} or its folder images: put it there"
            )
        camera, pose = image.camera, image.cam_from_world()
        if not _is_pinhole(camera):
            raise ImageError(
                f"a camera in {place} is no pinhole camera, but has the model {camera.model_name}: "
                "undistort the images to PINHOLE first (colmap image_undistorter)"
            )
        # In COLMAP, the centre of the first pixel is (0.5, 0.5).
        matrix = camera.calibration_matrix() - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        moved = pose.rotation.matrix(), np.array(pose.translation)
        size = (camera.width, camera.height)
        images.append(_posed_image(paths[0], matrix, *moved, place, size))
    return sorted(images, key=lambda image: image.path)


def _is_pinhole(camera: Any) -> bool:
    """Return whether a `pycolmap.Camera` has no lens distortion, tested at its image's border."""
    if not camera.focal_length_idxs():  # a panorama
        return False
    size = np.array([camera.width, camera.height])
    pixels = np.array([(x, y, 1) for x in (0, size[0] / 2, size[0]) for y in (0, size[1])])
    rays = pixels @ np.linalg.inv(camera.calibration_matrix()).T
    moved = (np.asarray(camera.img_from_cam(rays)) - pixels[:, :2]) / size
    return bool((np.abs(moved) < np.finfo(np.float32).eps).all())


def _read_located(folder: Path) -> list[PosedImage]:
    paths = sorted(path for path in folder.iterdir() if path.suffix in SUFFIXES)
    fixes = [(path, fix) for path in paths if (fix := read_gps(path)) is not None]
    places = np.nan_to_num([(fix.latitude, fix.longitude, fix.altitude) for _, fix in fixes])
    metres = Origin(*places[0]).to_enu(places)
    unknown = Camera((1, 1), 1), np.eye(3)
    return [
        PosedImage(path.name, *unknown, -place, path)
        for (path, _), place in zip(fixes, metres, strict=True)
    ]


def _posed_image(
    path: Path,
    intrinsics: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
    where: str | Path,
    size: tuple[float, float] | None = None,
) -> PosedImage:
    """Check the camera of an image, and return the image with its camera.

    The camera matrix is for an image of `size` (width, height). If it is None, it is the file's.
    """
    wrong = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if wrong > MAX_ROTATION_ERROR or np.linalg.det(rotation) < 0:
        raise ImageError(f"{where} has no valid rotation matrix: its columns must be orthonormal")
    own = _image_size(path)
    size = size or own
    if min(size) < 1 or abs(own[0] * size[1] / (own[1] * size[0]) - 1) > MAX_ASPECT_ERROR:
        raise ImageError(
            f"{path} is {own[0]}x{own[1]} pixels, but {where} is for {size[0]:g}x{size[1]:g}: take "
            "images of the same aspect ratio"
        )
    focal, centre = np.diag(intrinsics)[:2], intrinsics[:2, 2]
    expected = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]])
    if focal.min() <= 0 or np.any(intrinsics != expected):
        raise ImageError(
            f"the camera matrix of {path.name} must have the rows fx 0 cx, 0 fy cy and 0 0 1, with "
            f"focal lengths above 0: correct the camera that belongs to {where}"
        )
    camera = Camera(size, focal.tolist(), centre.tolist())
    camera = camera if camera.size == own else camera.scaled(own)
    return PosedImage(path.name, camera, rotation, translation, path)


def _image_size(path: Path) -> tuple[int, int]:
    with open_image(path) as opened:
        size: tuple[int, int] = opened.size
        turned = orientation_of(opened) in UPRIGHT
    if turned:
        raise ImageError(
            f"{path} is rotated by its EXIF orientation: save it upright without that tag"
        )
    return size


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise ImageError(f"{path} cannot be read ({error.strerror}): check the folder") from None
    except UnicodeDecodeError:
        raise ImageError(f"{path} is not a text file: get it again") from None


def _numbers(words: Sequence[str], count: int, where: str) -> np.ndarray:
    try:
        numbers = np.array(words, np.float64)
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ImageError(f"{where} must hold {count} numbers: get the file again")
    return numbers
