"""Readers of camera files of SLAM programs, devices and photogrammetry, and what all readers share.

A reader takes the parsed file and the (width, height) of the image, if it is known, and returns the
cameras as objects with names that `view_of` knows, or None for a file of another format. Its errors
continue a sentence that begins with the format, such as "has distortion (k1 -0.1): ...".
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .._shared.errors import ReconstructionError

Values = Mapping[str, Any]
Size = tuple[int, int] | None

MM_PER_M = 1000.0
MM_PER_CM = 10.0

ROUNDING = 1e-9
"""Distortion coefficients up to this are zeros with rounding errors, because even at the corner of
a large image they would move a pixel by less than a ten-thousandth."""

MIN_FOCAL = 0.1
"""A focal length under this fraction of the longer side of the image is refused as one in another
unit, because in pixels it would mean a pinhole camera with a field of view above 157 degrees."""

MATRICES = (
    *("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "k", "M1", "K1", "cameraMatrix1"),
    *("intrinsicMatrix", "intrinsic_matrix", "IntrinsicMatrix", "intrinsic", "intrinsics", "cam_K"),
)
FOCAL_LENGTHS = (
    *(("fx", "fy"), ("flx", "fly"), ("focalx", "focaly"), ("focallengthx", "focallengthy")),
    *(("focallength",), ("focal",), ("f",)),
)
CENTRES = ("cx", "cy"), ("ppx", "ppy"), ("principalpoint",)
SIZES = (
    *(("width", "height"), ("w", "h"), ("cols", "rows"), ("imagewidth", "imageheight")),
    ("resolution",),
)
"""Names of values in other programs; the last three in lower case and without underscores."""

MODELS = re.compile(r"(camera|distortion)?_?(model|type)|model_type|projection(_type)?|poly.*_name")
NO_PINHOLES = re.compile(
    r"fisheye|equi|spheric|cylind|omni|kannala|theta|panoram|unified|eucm|double|dual|division|"
    r"orthogr|\b(ds|mei|fov|rpc)\b",
    re.IGNORECASE,
)
"""Camera models with one of these words in their name are refused, even without distortion."""

COEFFICIENTS = re.compile(r".*(distortion|disto_|dist_?coef).*|dist|coeffs?|coefficients|fisheye")
DISTORTIONS = re.compile(rf"{COEFFICIENTS.pattern}|[kp]\d|s\d|b2|skew|d\d?|xi|alpha|beta|omega")

ZED_SIZES = {
    **{"2K": (2208, 1242), "FHD": (1920, 1080), "FHD1200": (1920, 1200)},
    **{"HD": (1280, 720), "SVGA": (960, 600), "VGA": (672, 376)},
}
"""Sizes of images in pixels, by the names that the sections of ZED's files have for them."""


class Found(NamedTuple):
    """The cameras of a file. If it is of a stereo pair, two of them are the left and the right."""

    cameras: Sequence[Values]
    stereo: bool = False
    baseline_mm: float | None = None


def numbers_in(value: Any) -> list[float]:
    """Return the numbers of nested lists and objects, also those in text, but no booleans."""
    if isinstance(value, Mapping):
        value = value["data"] if "data" in value else [*value.values()]
    if isinstance(value, list | tuple | np.ndarray):
        return [number for each in value for number in numbers_in(each)]
    try:
        return [] if value is None or isinstance(value, bool) else [float(value)]
    except (TypeError, ValueError):
        return []


def of_line(numbers: Sequence[float]) -> Values:
    """Return the camera of a line with fx, fy, cx, cy and coefficients."""
    named = dict(zip(("fx", "fy", "cx", "cy"), numbers, strict=False))
    return {**named, "coefficients": numbers[4:]}


def matrix_at(values: Values, keys: Iterable[str], *sizes: int) -> np.ndarray | None:
    """Return the first value at `keys` whose size is in `sizes`, as three rows, or else None."""
    for key in keys:
        value = values.get(key)
        data = value.get("data") if isinstance(value, Mapping) else value
        if data is not None and np.size(data) in sizes and not isinstance(data[0], Mapping):
            return np.array(data, np.float64).reshape(3, -1)
    return None


def objects_in(values: Any, name: str = "") -> Iterator[tuple[str, Values]]:
    """Yield all objects of a file, outer ones first, each with the names that lead to it."""
    if isinstance(values, Mapping):
        yield name, values
    of_list = enumerate(values) if isinstance(values, list) else ()
    for key, value in values.items() if isinstance(values, Mapping) else of_list:
        yield from objects_in(value, f"{name} {key}".lower())


def check_pinhole(values: Values, names: re.Pattern[str] = DISTORTIONS) -> None:
    """Raise an error if one of the values says that the camera is no pinhole without distortion."""
    for key, value in values.items():
        name, numbers = str(key).lower(), numbers_in(value)
        words = value.replace("_", " ") if isinstance(value, str) else ""
        if (MODELS.fullmatch(name) and NO_PINHOLES.search(words)) or ("fisheye" in name and value):
            raise ReconstructionError(f"has a camera that is no pinhole ({key}: {value})")
        if names.fullmatch(name) and not all(abs(number) <= ROUNDING for number in numbers):
            raise ReconstructionError(
                f"has distortion ({key} {', '.join(f'{n:g}' for n in numbers)}), which is not "
                "supported: undistort the images, for example with cv2.undistort, and give the "
                "camera matrix without coefficients"
            )


def _pair_at(values: Values, choices: Iterable[tuple[str, ...]]) -> list[float]:
    """Return the two numbers (one is repeated) at the first names that there are, or none."""
    for names in choices:
        if numbers := [n for name in names for n in numbers_in(values.get(name))]:
            if len(numbers) < len(names):
                raise ReconstructionError(f"has only one of {' and '.join(names)}: add the other")
            return (numbers * 2)[:2]
    return []


def _of_matrix(matrix: np.ndarray, first: float | None) -> tuple[list[float], list[float], float]:
    """Return focal lengths, principal point, and the x and y of the centre of the first pixel."""
    left, last = matrix[:, :3], (0, 0, 1)
    if not np.allclose(left[2], last) and np.allclose(left[:, 2], last):
        left = left.T
        if first is None:
            first = 1.0
            warnings.warn(
                "the camera matrix is transposed, as MATLAB writes it, so its principal point is "
                "read as MATLAB's, where the centre of the first pixel is (1, 1)",
                stacklevel=2,
            )
    if not np.allclose(left[2], last) or abs(left[1, 0]) > ROUNDING:
        rows = "; ".join(" ".join(f"{number:g}" for number in row) for row in matrix)
        raise ReconstructionError(f"has no camera matrix (fx 0 cx; 0 fy cy; 0 0 1), but {rows}")
    skew = float(left[0, 1])
    check_pinhole({"skew": skew if abs(skew) > ROUNDING * abs(left[0, 0]) else 0})
    (fx, _, cx), (_, fy, cy) = left[:2].tolist()
    return [fx, fy], [cx, cy], first or 0.0


def view_of(values: Values, image: Size, first: float | None = None) -> dict[str, Any] | None:
    """Return the view that one object describes in the usual names, in the keys of calib.json.

    `first` is the x and y of the centre of the first pixel in this format. None means 0, but 1 for a
    transposed matrix. If the object describes no camera, None is returned.
    """
    own = {re.sub("[_ ]", "", str(key)).lower(): value for key, value in values.items()}
    size = _pair_at(own, SIZES)
    if (matrix := matrix_at(values, MATRICES, 9, 12)) is not None:
        focal, centre, first = _of_matrix(matrix, first)
    elif np.shape(numbers := own.get("intrinsics")) == (4,):  # Kalibr's fx, fy, cx, cy
        focal, centre = numbers_in(numbers)[:2], numbers_in(numbers)[2:]
    else:
        focal, centre = _pair_at(own, FOCAL_LENGTHS), _pair_at(own, CENTRES)
        if not centre and not {"fx", "flx", "focalx"} & {*own}:
            return None
        if not centre or not focal:
            missing = "principal point (cx, cy)" if focal else "focal length (fx, fy)"
            raise ReconstructionError(f"has no {missing}: add it in pixels")
    check_pinhole(values)
    if not min(focal) > 0:
        raise ReconstructionError(f"has the focal length {min(focal):g}: it must be above 0 pixels")
    x, y = (number - (first or 0) for number in centre)
    width, height = size or image or (math.inf, math.inf)
    shown = f"for images of {width:g}x{height:g} pixels"
    if math.isfinite(width) and max(focal) < MIN_FOCAL * max(width, height):
        raise ReconstructionError(
            f"has a focal length of {max(focal):g} {shown}: give it in pixels of these images"
        )
    rectified = matrix is not None and matrix.shape[1] == 4  # the centre may lie outside the image
    if not rectified and not (-1 <= x <= width and -1 <= y <= height):
        raise ReconstructionError(
            f"has the principal point ({x:g}, {y:g}) {shown}, outside of them: check the order and "
            "the unit of the numbers"
        )
    sides = dict(zip(("width", "height"), map(int, size), strict=False))
    return {"focal_px": focal, "cx": x, "cy": y, **sides}


def plain(values: Values, image: Size) -> Found | None:
    """Read any file that has cameras in the usual names; left and right by their names."""
    found, sides = [], {"left": [], "right": []}  # type: tuple[list[Values], dict[str, list[Values]]]
    for name, each in objects_in(values):
        check_pinhole(each, COEFFICIENTS)
        if view_of(each, None, 0.0) is not None:
            found.append(each)
            for side in sides:
                sides[side] += [each] if side in name else []
    if all(len(each) == 1 for each in sides.values()):
        return Found([*sides["left"], *sides["right"]], True)
    return Found(found) if found else None


def orb_slam(values: Values, image: Size) -> Found | None:
    """Read settings of ORB-SLAM or stella_vslam. Lengths are in metres, also in fx * baseline."""
    shared = values.get("Camera", {})
    if not isinstance(shared, Mapping):
        return None
    check_pinhole(shared)
    found = [{**shared, **values[key]} for key in ("Camera1", "Camera2") if key in values]
    found, stereo, metres = found or [shared], values.get("Stereo", {}), 0.0
    if product := float(shared.get("bf", shared.get("focal_x_baseline", 0))):
        metres = product / float(found[0]["fx"])
    elif "b" in stereo:
        metres = float(stereo["b"])
    elif "T_c1_c2" in stereo:
        metres = math.hypot(*numbers_in(stereo["T_c1_c2"])[3:12:4])
    if re.search("depth_?map_?factor", str(values), re.IGNORECASE):
        metres = 0.0  # of a depth camera, whose two cameras do not take the images
    return Found(found, True, metres * MM_PER_M)


def zed(values: Values, image: Size) -> Found:
    """Read ZED's SN.conf, which has sections by the size of the image, and the baseline in mm."""
    sizes = {name: size for name, size in ZED_SIZES.items() if f"LEFT_CAM_{name}" in values}
    name = next((name for name, size in sizes.items() if image in (None, size)), None)
    if name is None:
        known = ", ".join(f"{width}x{height}" for width, height in sizes.values())
        raise ReconstructionError(f"has no section for this size of images, only for {known}")
    both = (values[f"{side}_CAM_{name}"] for side in ("LEFT", "RIGHT"))
    cameras = [{**each, "resolution": sizes[name]} for each in both]
    return Found(cameras, True, float(values["STEREO"]["Baseline"]))


def depthai(values: Values, image: Size) -> Found:
    """Read DepthAI's calibration: left and right camera, or the only one. Lengths are in cm."""
    data = values["cameraData"]
    pairs = data.items() if isinstance(data, Mapping) else data
    cameras = {int(key): each for key, each in pairs if any(numbers_in(each["intrinsicMatrix"]))}
    for each in cameras.values():
        check_pinhole({"fisheye": each.get("cameraType") == 1})
    stereo = values.get("stereoRectificationData", {})
    sockets = [stereo.get(f"{side}CameraSocket", -1) for side in ("left", "right")]
    left, right = sockets if {*sockets} <= {*cameras} else (1, 2)
    sizes = {key: (each.get("width"), each.get("height")) for key, each in cameras.items()}
    if not {left, right} <= {*cameras} or (image in sizes.values() and sizes[left] != image):
        return Found([*cameras.values()])
    move = cameras[left].get("extrinsics", {})
    if move.get("toCameraSocket") != right:
        move = cameras[right].get("extrinsics", {})
    lengths = [math.hypot(*numbers_in(move.get(k))) for k in ("translation", "specTranslation")]
    linked = move.get("toCameraSocket") in (left, right)
    length = (lengths[0] or lengths[1]) * MM_PER_CM if linked else None
    return Found([cameras[left], cameras[right]], True, length)


def opensfm(values: Values, image: Size) -> Found | None:
    """Read OpenSfM's camera models: fractions of the longer side, from the middle of the image."""
    cameras = []
    for each in (each for _, each in objects_in(values) if "projection_type" in each):
        check_pinhole(each)
        size = np.array(
            (each.get("width"), each.get("height")) if each.get("width") else image or (1, 1)
        )
        focal = [each["focal"]] if "focal" in each else [each["focal_x"], each["focal_y"]]
        centre = (size - 1) / 2 + size.max() * np.array([each.get("c_x", 0), each.get("c_y", 0)])
        sides = {key: each[key] for key in ("width", "height") if each.get(key)}
        cameras.append({"focal": size.max() * np.array(focal), "principal_point": centre, **sides})
    return Found(cameras) if cameras else None


def meshroom(values: Values, image: Size) -> Found | None:
    """Read Meshroom's cameras.sfm.

    Since version 1.2.1 the principal point is relative to half the width and half the height, since
    1.2.2 the focal length is in mm, and since 1.2.5 `pixelRatio` is fy / fx instead of fx / fy.
    """
    if not any("intrinsicId" in each for each in values["intrinsics"]):
        return None
    version, cameras = numbers_in(values["version"]), []
    for each in values["intrinsics"]:
        check_pinhole(each)
        size = np.array([float(each["width"]), float(each["height"])])
        focal = numbers_in(each.get("pxFocalLength"))
        if not focal:
            fx = float(each["focalLength"]) / float(each["sensorWidth"]) * size[0]
            ratio = float(each.get("pixelRatio", 1))
            focal = [fx, fx * (ratio if version >= [1, 2, 5] else 1 / ratio)]
        middle = size / 2 * (version >= [1, 2, 1])
        centre = np.array(numbers_in(each["principalPoint"])) + middle
        cameras.append({"focal": focal, "principal_point": centre, "resolution": size})
    return Found(cameras)


def metashape(values: Values, image: Size) -> Found:
    """Read Metashape's calibration, or its cameras of a chunk.

    The principal point is relative to half the width and half the height. PhotoScan before 1.2 has
    fx and fy instead of f, and a principal point from the corner of the image.
    """
    root, cameras = values["metashape"], []
    sensors = [each.findall("calibration") for each in root.iter("sensor")]
    for found in [[root]] if root.tag == "calibration" else sensors:
        for node in sorted(found, key=lambda each: each.get("class") != "adjusted")[:1]:
            own = {**node.attrib, **{child.tag: child.text for child in node}}
            inner = node.find("resolution")
            size = own if inner is None else inner.attrib
            sides = np.array([int(size["width"]), int(size["height"])])
            centre = np.array([float(own.pop(key, None) or 0) for key in ("cx", "cy")])
            if "fx" not in own:
                own["fx"], own["fy"] = float(own["f"]) + float(own.get("b1") or 0), own["f"]
                centre += sides / 2
            cameras.append({**own, "principal_point": centre, "resolution": sides})
    return Found(cameras)


def bundler(values: Values, image: Size) -> Found:
    """Read a file of Bundler, whose principal point is the middle of the image."""
    cameras, middle = [], (np.array(image or (1, 1)) - 1) / 2
    for start in range(2, 2 + 15 * int(values["bundler"][0]), 15):  # f k1 k2, rotation, translation
        focal, *distortion = values["bundler"][start : start + 3]
        if focal:  # it is 0 for images without a pose
            cameras.append({"f": focal, "coefficients": distortion, "principal_point": middle})
    return Found(cameras)


def nerfstudio(values: Values, image: Size) -> Found:
    """Read transforms.json of nerfstudio or instant-ngp, whose frames may have own cameras."""
    cameras = []
    for frame in values.get("frames") or [{}]:
        own = {"cx": None, **values, **frame}
        if "fl_x" not in own and "camera_angle_x" not in own:
            raise ReconstructionError("has neither fl_x nor camera_angle_x: add fl_x in pixels")
        size = np.array((own["w"], own["h"]) if "w" in own else image or (1, 1))
        angles = own.get("camera_angle_x"), own.get("camera_angle_y")
        fx, fy = (a and side / 2 / math.tan(a / 2) for a, side in zip(angles, size, strict=True))
        fx, fy = own.get("fl_x") or fx, own.get("fl_y") or own.get("fl_x") or fy or fx
        cx, cy = size / 2 if own["cx"] is None else (own["cx"], own["cy"])
        cameras.append({**own, "fx": fx, "fy": fy, "cx": cx, "cy": cy})
    return Found(cameras)
