"""Readers of camera files of SLAM programs, devices and photogrammetry, and what all readers share.

A reader takes the parsed file and the (width, height) of the image, if it is known, and returns the
cameras as objects with names that `view_of` knows, or None for a file of another format.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from .._shared.errors import ReconstructionError

Values = Mapping[str, Any]
Pair = tuple[int, int] | None

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
    "matrix",
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

DISTORTIONS = re.compile(
    r".*(distortion|disto_|dist_?coef).*|dist|coeffs?|coefficients|[kps]\d|b2|skew|d\d?|xi|omega"
)

ZED_SIZES = {
    **{"2K": (2208, 1242), "FHD": (1920, 1080), "FHD1200": (1920, 1200)},
    **{"HD": (1280, 720), "SVGA": (960, 600), "VGA": (672, 376)},
}
"""Sizes of images in pixels, by the names that the sections of ZED's files have for them."""


class Found(NamedTuple):
    """The cameras of a file. The first two of a stereo pair are the left and the right one."""

    cameras: Sequence[Values]
    stereo: bool = False
    baseline_mm: float | None = None


class Format(NamedTuple):
    """A format: whose file it is, a pattern that one of its keys has, and its reader.

    `first` is the x and y of the centre of the first pixel; None means 0, but 1 for a transposed
    matrix. Principal points begin in the "corner" or in the "middle" of the image; "fractions" are
    of its longer side, from the middle.
    """

    name: str
    key: str
    read: Callable[[Values, Pair], Found | None]
    first: float | None = None
    origin: Literal["corner", "middle", "fractions"] = "corner"


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
    if isinstance(values, list):
        values = dict(enumerate(values))
    if isinstance(values, Mapping):
        yield name, values
        for key, value in values.items():
            yield from objects_in(value, f"{name} {key}".lower())


def check_pinhole(values: Values) -> None:
    """Raise an error if one of the values says that the camera is no pinhole without distortion."""
    for key, value in values.items():
        name, numbers = str(key).lower(), numbers_in(value)
        words = value.replace("_", " ") if isinstance(value, str) else ""
        if (MODELS.fullmatch(name) and NO_PINHOLES.search(words)) or ("fisheye" in name and value):
            raise ReconstructionError(
                f"it has a camera that is no pinhole ({key} {value!r}): undistort the images"
            )
        name = name if len(numbers) == 1 else name.rstrip("0123456789")  # K1 may be a matrix
        if DISTORTIONS.fullmatch(name) and not all(abs(number) <= ROUNDING for number in numbers):
            raise ReconstructionError(
                f"it has distortion ({key} {', '.join(f'{n:g}' for n in numbers)}), which is not "
                "supported: undistort the images, for example with cv2.undistort, and give the "
                "camera matrix without coefficients"
            )


def _pair_at(values: Values, choices: Iterable[tuple[str, ...]]) -> list[float]:
    """Return the two numbers (one is repeated) at the first names that there are, or none."""
    for names in choices:
        if numbers := [n for name in names for n in numbers_in(values.get(name))]:
            if len(numbers) < len(names):
                raise ReconstructionError(f"it lacks {names[0]} or {names[1]}: add the other")
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
                "the camera matrix is transposed, as MATLAB writes it, so the centre of the first "
                "pixel is taken to be (1, 1), as in MATLAB",
                stacklevel=2,
            )
    if not np.allclose(left[2], last) or abs(left[1, 0]) > ROUNDING:
        wrong, right = (left[1], "0 fy cy") if np.allclose(left[2], last) else (left[2], "0 0 1")
        row = " ".join(f"{number:g}" for number in wrong)
        raise ReconstructionError(
            f"it has a matrix with the row {row} instead of {right}: give fx 0 cx; 0 fy cy; 0 0 1"
        )
    skew = float(left[0, 1])
    check_pinhole({"skew": skew if abs(skew) > ROUNDING * abs(left[0, 0]) else 0})
    (fx, _, cx), (_, fy, cy) = left[:2].tolist()
    return [fx, fy], [cx, cy], first or 0.0


def view_of(values: Values, image: Pair, form: Format) -> dict[str, Any] | None:
    """Return the view that one object describes in the usual names, in the keys of calib.json.

    If the object describes no camera, None is returned.
    """
    own = {re.sub("[_ ]", "", str(key)).lower(): value for key, value in values.items()}
    size, first, centre = _pair_at(own, SIZES), form.first, _pair_at(own, CENTRES)
    focal = _pair_at(own, FOCAL_LENGTHS)
    if (matrix := matrix_at(values, MATRICES, 9, 12)) is not None:
        focal, centre, first = _of_matrix(matrix, first)
    elif np.shape(line := own.get("intrinsics", ())) == (4,):  # fx, fy, cx, cy, as Kalibr has them
        focal, centre = numbers_in(line)[:2], numbers_in(line)[2:]
    if form.origin == "corner" and not (focal and centre):
        if not centre and not {"fx", "flx", "focalx"} & {*own}:
            return None
        missing = "principal point (cx, cy)" if focal else "focal length (fx, fy)"
        raise ReconstructionError(f"it has no {missing}: add it in pixels")
    check_pinhole(values)
    sides = np.array(size or image or (1, 1), np.float64)
    if form.origin != "corner":
        unit = sides.max() if form.origin == "fractions" else 1.0
        focal = [unit * number for number in focal]
        centre = (unit * np.array(centre or (0, 0)) + (sides - 1) / 2).tolist()
    x, y = (number - (first or 0) for number in centre)
    if not focal or min(focal) <= 0 or not math.isfinite(sum(focal)):
        raise ReconstructionError(f"it has no focal length above 0, but {focal}: correct it")
    rectified = matrix is not None and matrix.shape[1] == 4  # the centre may lie outside the image
    inside = rectified or (-1 <= x <= sides[0] and -1 <= y <= sides[1])
    if (size or image) and (max(focal) < MIN_FOCAL * max(sides) or not inside):
        raise ReconstructionError(
            f"it has the focal length {max(focal):g} and the principal point ({x:g}, {y:g}) for "
            f"images of {sides[0]:g}x{sides[1]:g} pixels: check the order and unit of the numbers"
        )
    if (size or image) and not rectified and math.hypot(x, y) < math.hypot(*(sides / 2 - (x, y))):
        warnings.warn(
            f"the principal point ({x:g}, {y:g}) is nearer to the corner of the image than to its "
            "middle: if it is relative to the middle, add half the width and half the height",
            stacklevel=2,
        )
    shape = dict(zip(("width", "height"), map(int, size), strict=False))
    return {"focal_px": focal, "cx": x, "cy": y, **shape}


def plain(values: Values, image: Pair) -> Found | None:
    """Read any file that has cameras in the usual names; left and right by their names."""
    found, probe = [], ANY._replace(first=0.0)
    for name, each in objects_in(values):
        check_pinhole(each)
        found += [(name, each)] if view_of(each, None, probe) else []
    sides = [[each for name, each in found if side in name] for side in ("left", "right")]
    stereo = [len(side) for side in sides] == [1, 1]
    cameras = sides[0] + sides[1] if stereo else [each for _, each in found]
    return Found(cameras, stereo) if found else None


ANY = Format("the file", ".*", plain)


def openmvg(values: Values, image: Pair) -> Found | None:
    """Read OpenMVG's sfm_data.json."""
    return plain({"intrinsics": values["intrinsics"]}, image)


def orb_slam(values: Values, image: Pair) -> Found | None:
    """Read settings of ORB-SLAM or stella_vslam. Lengths are in metres, also in fx * baseline."""
    shared: Any = values.get("Camera", {})
    if not isinstance(shared, Mapping):
        return None
    check_pinhole(shared)
    found = [{**shared, **values[key]} for key in ("Camera1", "Camera2") if key in values]
    found, stereo = found or [dict(shared)], values.get("Stereo", {})
    metres = float(shared.get("bf", shared.get("focal_x_baseline", 0))) / float(found[0]["fx"])
    metres = metres or float(stereo.get("b", 0))
    metres = metres or math.hypot(*numbers_in(stereo.get("T_c1_c2"))[3:12:4])
    if re.search("depth_?map_?factor", str(values), re.IGNORECASE):
        metres = 0.0  # the two cameras of a depth camera do not take the images
    return Found(found, True, metres * MM_PER_M)


def zed(values: Values, image: Pair) -> Found:
    """Read ZED's SN.conf, which has sections by the size of the image, and the baseline in mm."""
    sizes = {name: size for name, size in ZED_SIZES.items() if f"LEFT_CAM_{name}" in values}
    name = next((name for name, size in sizes.items() if image in (None, size)), None)
    if name is None:
        known = ", ".join(f"{width}x{height}" for width, height in sizes.values())
        raise ReconstructionError(
            f"it has no section for this size of images, only for {known}: resize them"
        )
    both = (values[f"{side}_CAM_{name}"] for side in ("LEFT", "RIGHT"))
    cameras = [{**each, "resolution": sizes[name]} for each in both]
    return Found(cameras, True, float(values["STEREO"]["Baseline"]))


def depthai(values: Values, image: Pair) -> Found:
    """Read DepthAI's calibration: left, right and other cameras. Lengths are in cm."""
    data = values["cameraData"]
    pairs = data.items() if isinstance(data, Mapping) else data
    cameras = {int(key): each for key, each in pairs if any(numbers_in(each["intrinsicMatrix"]))}
    for each in cameras.values():
        check_pinhole({"fisheye": each.get("cameraType") == 1})
    rig = values.get("stereoRectificationData", {})
    ends = [rig.get(f"{side}CameraSocket", -1) for side in ("left", "right")]
    ends = ends if {*ends} <= {*cameras} else [1, 2]
    lengths: list[float] = []
    for start, end in (ends, ends[::-1]):
        move = cameras.get(start, {}).get("extrinsics", {})
        for name in ("translation", "specTranslation") if move.get("toCameraSocket") == end else ():
            lengths.append(math.hypot(*numbers_in(move.get(name))))
    ordered = [cameras[key] for key in sorted(cameras, key=[*ends, *cameras].index)]
    length = next(filter(None, lengths), 0.0)
    return Found(ordered, {*ends} <= {*cameras}, length * MM_PER_CM)


def opensfm(values: Values, image: Pair) -> Found | None:
    """Read OpenSfM's camera models or reconstruction."""
    cameras = [each for _, each in objects_in(values) if "projection_type" in each]
    return Found(cameras) if cameras else None


def meshroom(values: Values, image: Pair) -> Found | None:
    """Read Meshroom's cameras.sfm.

    Since version 1.2.1 the principal point is relative to half the width and half the height, since
    1.2.2 the focal length is in mm, and since 1.2.5 `pixelRatio` is fy / fx instead of fx / fy.
    """
    if not any(isinstance(each, Mapping) and "type" in each for each in values["intrinsics"]):
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
        centre = np.array(numbers_in(each["principalPoint"])) + size / 2 * (version >= [1, 2, 1])
        cameras.append({"focal": focal, "principal_point": centre, "resolution": size})
    return Found(cameras)


def metashape(values: Values, image: Pair) -> Found:
    """Read Metashape's calibration, or its cameras of a chunk."""
    root, cameras = values["metashape"], []
    sensors = [each.findall("calibration") for each in root.iter("sensor")]
    for found in [[root]] if root.tag == "calibration" else sensors:
        for node in sorted(found, key=lambda each: each.get("class") != "adjusted")[:1]:
            own = {**node.attrib, **{child.tag: child.text for child in node}}
            own |= {} if (size := node.find("resolution")) is None else size.attrib
            fx = float(own["f"]) + float(own.get("b1", 0))
            cameras.append({**own, "fx": fx, "fy": own["f"]})
    return Found(cameras)


def bundler(values: Values, image: Pair) -> Found:
    """Read a file of Bundler: f, k1, k2, rotation and translation; f is 0 without a pose."""
    count, _, *numbers = values["bundler"]
    rows = np.reshape(numbers[: 15 * int(count)], (-1, 15)).tolist()
    return Found([{"f": row[0], "coefficients": row[1:3]} for row in rows if row[0]])


def nerfstudio(values: Values, image: Pair) -> Found:
    """Read transforms.json of nerfstudio or instant-ngp, whose frames may have own cameras."""
    cameras = []
    for frame in values.get("frames") or [{}]:
        own = {**values, **frame}
        if "fl_x" not in own and "camera_angle_x" not in own:
            raise ReconstructionError("it has neither fl_x nor camera_angle_x: add fl_x in pixels")
        size = np.array((own["w"], own["h"]) if "w" in own else image or (1, 1))
        angles = own.get("camera_angle_x"), own.get("camera_angle_y")
        fx, fy = (a and side / 2 / math.tan(a / 2) for a, side in zip(angles, size, strict=True))
        fx, fy = own.get("fl_x") or fx, own.get("fl_y") or own.get("fl_x") or fy or fx
        centre = (own["cx"], own["cy"]) if "cx" in own else size / 2
        cameras.append({**own, "fx": fx, "fy": fy, **dict(zip(("cx", "cy"), centre, strict=True))})
    return Found(cameras)
