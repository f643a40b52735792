"""Readers of camera files of other programs. A format is recognised by the content of the file.

All readers return a dictionary with the keys of calib.json, which the module `camera` describes.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from .._shared.errors import ReconstructionError

Values = Mapping[str, Any]

STEREO = (
    *(("P1", "P2", ""), ("M1", "M2", "D"), ("K1", "K2", "D")),
    ("cameraMatrix1", "cameraMatrix2", "distCoeffs"),
)
"""Keys in OpenCV's files. A row has the keys of the left and the right camera matrix, and those of
the distortion coefficients without the final 1 or 2. The first row is for rectified views."""

MATRICES = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "k", "M1", "K1", "cameraMatrix1")
PROJECTIONS = ("projection_matrix", "P", "p")
DISTORTIONS = (
    *("distortion_coefficients", "Distortion_Coefficients", "distortion_coeffs", "distCoeffs"),
    *("dist_coeffs", "D", "d", "D1", "distCoeffs1"),
)

FILES_OF_PAIRS = (
    *(("left.yaml", "right.yaml"), ("intrinsics.yml", "extrinsics.yml")),
    *(("cam0/sensor.yaml", "cam1/sensor.yaml"), ("mav0/cam0/sensor.yaml", "mav0/cam1/sensor.yaml")),
)
"""Names of the two files that ROS, OpenCV or EuRoC write to a folder for a stereo pair."""

MM_PER_M = 1000.0

MIN_BASELINE_MM = 10.0
"""OpenCV's files do not state the unit of lengths. A baseline is taken to be in metres if its
number is smaller than this, else in mm. Chosen by hand."""

COLMAP_CENTRE = 0.5
"""The centre of the first pixel has this x and y in COLMAP. In this package they are 0."""

NUMBERS = r"([-+.\deE \t;,\[\]]+)\r?$"
COLMAP_LINE = re.compile(rf"^[ \t]*\d+[ \t]+([A-Z_]+)[ \t]{NUMBERS}", re.MULTILINE)
TEXT_LINE = re.compile(rf"^[ \t]*(\w+)[ \t]*[:=]{NUMBERS}", re.MULTILINE)

KNOWN = (
    "give a file of OpenCV, ROS, Kalibr, EuRoC, KITTI, Middlebury or COLMAP, a matrix of 3x3 "
    'numbers, or JSON such as {"focal_px": 1000, "cx": 320, "cy": 240, "baseline_mm": 120}'
)


def read_camera_file(path: Path, views: tuple[int, int] | None = None) -> dict[str, Any]:
    """Read a camera file, or a folder with two; return a dictionary with the keys of calib.json.

    `views` are the numbers of the left and the right camera in a KITTI file, which has several.

    Raises:
        ReconstructionError: the format is unknown, or the cameras have distortion.
        OSError: the file cannot be read. Any other exception means that the file is damaged.
    """
    if not path.is_dir():
        return _calib_json(_parsed(path.read_bytes()), views)
    for names in FILES_OF_PAIRS:
        if all((path / name).is_file() for name in names):
            first, second = (_parsed((path / name).read_bytes()) for name in names)
            if names[1] == "extrinsics.yml":
                return _calib_json({**first, **second}, views)
            left, right = _calib_json(first, None), _calib_json(second, None)
            return {**left, "right": right["right"], "baseline_mm": _distance(first, second)}
    wanted = ", or ".join(" and ".join(names) for names in FILES_OF_PAIRS)
    raise ReconstructionError(f"the folder does not contain {wanted}: give a file")


def _parsed(content: bytes) -> Values:
    """Parse a camera file, without `cv2.FileStorage`, which hangs or crashes on damaged files."""
    text = content.decode("utf-8", "replace").lstrip("\ufeff \r\n\t")
    if text.startswith("{"):
        return json.loads(text)
    if text.startswith("<"):
        return _xml_values(ElementTree.fromstring(text))
    numbers = _numbers(text)
    if len(numbers) in (9, 12):
        return {"camera_matrix": numbers}
    if cameras := COLMAP_LINE.findall(text):
        return {"cameras": [(model, _numbers(numbers)) for model, numbers in cameras]}
    lines = {key: _numbers(numbers) for key, numbers in TEXT_LINE.findall(text)}
    if any(re.fullmatch(r"P\d|P_rect_\d+|cam[01]", key) for key in lines):
        return lines
    import yaml

    Loader: Any = type("Loader", (yaml.SafeLoader,), {})  # a subclass, to accept OpenCV's tags
    Loader.add_multi_constructor("", lambda loader, _, node: loader.construct_mapping(node, True))
    # ROS ends its file with the start of a second YAML document, so only the first one is read.
    values = next(yaml.load_all(re.sub(r"\A%YAML[^\n]*\n", "", text), Loader), None)
    if not isinstance(values, dict):
        raise ReconstructionError(f"it holds no cameras: {KNOWN}")
    return values


def _numbers(text: str) -> list[float]:
    words = re.split(r"[\s,;\[\]]+", text.strip(" \t\r\n[]"))
    try:
        return [float(word) for word in words]
    except ValueError:
        return []


def _xml_values(node: ElementTree.Element) -> Any:
    if len(node):
        return {child.tag: _xml_values(child) for child in node}
    return _numbers(node.text or "") or node.text


def _matrix(values: Values, keys: Iterable[str], *sizes: int) -> np.ndarray | None:
    """Return the first value at `keys` whose size is in `sizes`, as three rows, or else None."""
    for key in keys:
        value = values.get(key)
        data = value.get("data") if isinstance(value, Mapping) else value
        if data is not None and np.size(data) in sizes:
            return np.array(data, np.float64).reshape(3, -1)
    return None


NO_PINHOLES = "fisheye", "equidistant", "equirectangular"
"""Camera models with one of these words in their name are rejected, even without distortion."""


def _check_distortion(value: Any, model: Any) -> None:
    if any(name in str(model).lower() for name in NO_PINHOLES):
        raise ReconstructionError(f"its model is {model}: give a pinhole camera")
    data = value.get("data") if isinstance(value, Mapping) else value
    numbers = np.array(0 if data is None else data, np.float64).ravel()
    if numbers.any():
        raise ReconstructionError(
            f"its cameras have distortion ({model} {', '.join(f'{n:g}' for n in numbers)}), which "
            "is not supported: undistort the images, for example with cv2.undistort, and give the "
            "camera matrix without coefficients"
        )


def _both(left: np.ndarray, right: np.ndarray, size: Any, baseline_mm: Any) -> dict[str, Any]:
    """Return a dictionary with the keys of calib.json for two camera matrices."""
    views = [
        {"focal_px": [float(m[0, 0]), float(m[1, 1])], "cx": float(m[0, 2]), "cy": float(m[1, 2])}
        for m in (left, right)
    ]
    values = {**views[0], "left": views[0], "right": views[1], "baseline_mm": baseline_mm}
    names = ("width", "height") if size is not None else ()
    return values | {n: int(np.ravel(value)[0]) for n, value in zip(names, size or (), strict=True)}


def _metres(left: np.ndarray, right: np.ndarray) -> float | None:
    """Return the distance between the cameras of two projection matrices; None if not known."""
    if left.shape[1] < 4 or right.shape[1] < 4:
        return None
    distance = float(left[0, 3] / left[0, 0] - right[0, 3] / right[0, 0])
    if distance < 0:
        raise ReconstructionError("its second camera is to the left of its first: swap the two")
    return distance or None


def _distance(first: Values, second: Values) -> float | None:
    """Return the baseline in mm from two camera poses (EuRoC) or two projection matrices (ROS)."""
    if "T_BS" in first and "T_BS" in second:
        left, right = (np.reshape(each["T_BS"]["data"], (4, 4))[:3, 3] for each in (first, second))
        return float(np.linalg.norm(left - right)) * MM_PER_M
    p0, p1 = (_matrix(each, PROJECTIONS, 12) for each in (first, second))
    distance = None if p0 is None or p1 is None else _metres(p0, p1)
    return distance and distance * MM_PER_M


def _calib_json(values: Values, views: tuple[int, int] | None) -> dict[str, Any]:
    own = {"focal_px", "left", "right", "baseline_mm", "disparity_offset_px", "cx", "cy"}
    if not values or own & {*values}:
        return dict(values)
    for read in (_colmap, _kitti, _middlebury, _kalibr, _opencv):
        if (found := read(values, views)) is not None:
            return found
    keys = ", ".join(map(str, [*values][:5]))
    raise ReconstructionError(f"it has no cameras in a known format, only the keys {keys}: {KNOWN}")


def _colmap(values: Values, _: Any) -> dict[str, Any] | None:
    cameras = values.get("cameras")
    if not cameras:
        return None
    if len(cameras) > 2:
        raise ReconstructionError(f"it has {len(cameras)} cameras: keep the left and the right one")
    made = []
    for model, (width, height, *numbers) in cameras:
        _check_distortion(0, model)
        if model.startswith(("SIMPLE_", "RADIAL")):  # these models have a single focal length
            numbers.insert(0, numbers[0])
        fx, fy, cx, cy, *distortion = numbers
        _check_distortion(distortion, model)
        matrix = np.array([[fx, 0, cx - COLMAP_CENTRE], [0, fy, cy - COLMAP_CENTRE], [0, 0, 1]])
        size = {"width": int(width), "height": int(height)}
        made.append({**_both(matrix, matrix, None, None)["left"], **size})
    return {**made[0], "left": made[0], "right": made[-1]}


def _kitti(values: Values, views: tuple[int, int] | None) -> dict[str, Any] | None:
    """Read KITTI's P0 to P3 (odometry) or P_rect_00 to P_rect_03 (raw), by default 2 and 3."""
    for start in ("P", "P_rect_0"):
        for pair in (views or (2, 3), (2, 3), (0, 1)):
            left, right = (_matrix(values, [f"{start}{view}"], 12) for view in pair)
            if left is not None and right is not None:
                distance = _metres(left, right)
                size = values.get(f"S_rect_0{pair[0]}")
                return _both(left, right, size, distance and distance * MM_PER_M)
    return None


def _middlebury(values: Values, _: Any) -> dict[str, Any] | None:
    left, right = (_matrix(values, [key], 9) for key in ("cam0", "cam1"))
    if left is None or right is None:
        return None
    if offset := values.get("doffs"):
        right[0, 2] = left[0, 2] + offset[0]
    return _both(left, right, _size(values), values.get("baseline", [None])[0])


def _kalibr(values: Values, _: Any) -> dict[str, Any] | None:
    """Read a camera chain of Kalibr, or a file with one camera, such as EuRoC's sensor.yaml."""
    cameras = [each for key in ("cam0", "cam1") if isinstance(each := values.get(key), Mapping)]
    matrices = []
    for camera in cameras or [values]:
        if not {"camera_model", "intrinsics"} <= {*camera}:
            return None
        if camera["camera_model"] != "pinhole":
            raise ReconstructionError(
                f"its model is {camera['camera_model']}: give a pinhole camera"
            )
        value = next((camera[key] for key in DISTORTIONS if key in camera), None)
        _check_distortion(value, camera.get("distortion_model"))
        fx, fy, cx, cy = map(float, camera["intrinsics"])
        matrices.append(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
    move = np.array(cameras[-1].get("T_cn_cnm1", np.eye(4)) if cameras else np.eye(4), np.float64)
    distance = float(np.linalg.norm(move[:3, 3])) * MM_PER_M
    return _both(matrices[0], matrices[-1], _size((cameras or [values])[0]), distance or None)


def _opencv(values: Values, _: Any) -> dict[str, Any] | None:
    """Read a file of OpenCV or ROS. If it has distortion, it also needs rectified projections."""
    for first, second, distortion in STEREO:
        left, right = (_matrix(values, [key], 9, 12) for key in (first, second))
        if left is not None and right is not None:
            for number in "12" if distortion else "":
                _check_distortion(values.get(distortion + number), "coefficients")
            move = _matrix(values, ["T"], 3)
            length = _metres(left, right)
            length = float(np.linalg.norm(move)) if length is None and move is not None else length
            unit = MM_PER_M if length and length < MIN_BASELINE_MM else 1.0
            return _both(left, right, _size(values), length and length * unit)
    matrix, projection = _matrix(values, MATRICES, 9, 12), _matrix(values, PROJECTIONS, 12)
    if projection is not None and projection[0, 0] > 0:
        return _both(projection, projection, _size(values), None)
    if matrix is None:
        return None
    value = next((values[key] for key in DISTORTIONS if key in values), None)
    _check_distortion(value, values.get("distortion_model", "coefficients"))
    return _both(matrix, matrix, _size(values), None)


def _size(values: Values) -> Any:
    for width, height in (("image_width", "image_height"), ("width", "height")):
        if width in values and height in values:
            return values[width], values[height]
    return values.get("resolution")
