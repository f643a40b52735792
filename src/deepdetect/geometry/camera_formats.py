"""Readers of camera files of SLAM programs, devices and photogrammetry, and what all readers share.

A reader takes the parsed file and the (width, height) of the image, if known, and returns a
dictionary with the keys of calib.json, or None for a file of another format. Its errors continue a
sentence that begins with the name of the format, such as "has distortion (k1 -0.1): ...".
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from .._shared.errors import ReconstructionError

Values = Mapping[str, Any]
Size = tuple[int, int] | None

MM_PER_M = 1000.0
MM_PER_CM = 10.0

HALF_PIXEL = 0.5
"""The centre of the first pixel has this x and y in COLMAP and nerfstudio. In this package they
are 0."""

ROUNDING = 1e-9
"""Distortion coefficients up to this are zeros with rounding errors: even at the corner of a large
image they would move a pixel by less than a ten-thousandth."""

MIN_FOCAL = 0.1
"""A focal length under this fraction of the longer side of the image is refused, because it is in
another unit: in pixels, it would mean a pinhole camera with a field of view above 157 degrees."""

MATRICES = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "k", "M1", "K1", "cameraMatrix1")
MORE_MATRICES = (*MATRICES, "intrinsicMatrix", "intrinsic_matrix", "intrinsic", "intrinsics", "cam_K")

PAIRS = {
    "focal length": (
        *(("fx", "fy"), ("flx", "fly"), ("focalx", "focaly"), ("focallengthx", "focallengthy")),
        *(("focallength",), ("focal",), ("f",)),
    ),
    "principal point": (("cx", "cy"), ("ppx", "ppy"), ("principalpoint",)),
    "size": (
        *(("width", "height"), ("w", "h"), ("cols", "rows"), ("imagewidth", "imageheight")),
        *(("resolution",), ("imagesize",)),
    ),
}
"""Names of values in other programs, lower case and without underscores."""

MODELS = re.compile(r"(camera|distortion)?_?(model|type)|model_type|projection(_type)?|polymorphic_.*")
NO_PINHOLES = re.compile(
    r"fisheye|equi|spheric|cylind|omni|kannala|theta|panoram|unified|eucm|double|dual|division|"
    r"orthogr|\b(ds|mei|fov|rpc)\b",
    re.IGNORECASE,
)
"""Camera models with one of these words in their name are refused, even without distortion."""

COEFFICIENTS = re.compile(r".*(distortion|disto_|dist_?coef).*|dist|coeffs?|coefficients|fisheye")
DISTORTIONS = re.compile(rf"{COEFFICIENTS.pattern}|[kp]\d|s[0-4]|b2|skew|d|xi|alpha|beta|omega")

ZED_SIZES = {
    **{"2K": (2208, 1242), "FHD": (1920, 1080), "FHD1200": (1920, 1200)},
    **{"HD": (1280, 720), "SVGA": (960, 600), "VGA": (672, 376)},
}
"""Image sizes in pixels by the names of their sections in ZED's files, as Stereolabs' SDK has."""


def numbers_in(value: Any) -> list[float]:
    """Return the numbers of nested lists and objects, also those in text, but no booleans."""
    if isinstance(value, Mapping):
        value = value["data"] if "data" in value else [*value.values()]
    if isinstance(value, list | tuple):
        return [number for each in value for number in numbers_in(each)]
    try:
        return [] if value is None or isinstance(value, bool) else [float(value)]
    except (TypeError, ValueError):
        return []


def check_model(model: Any) -> None:
    """Raise an error if the name of a camera model is that of a fisheye, a panorama or the like."""
    if isinstance(model, str) and NO_PINHOLES.search(model.replace("_", " ")):
        raise ReconstructionError(f"has the camera model {model}: give a pinhole camera")


def check_distortion(value: Any, name: Any) -> None:
    """Raise an error if a value has a number that is not zero; `name` is its name in the file."""
    numbers = numbers_in(value)
    if any(not abs(number) <= ROUNDING for number in numbers):
        raise ReconstructionError(
            f"has distortion ({name} {', '.join(f'{n:g}' for n in numbers)}), which is not "
            "supported: undistort the images, for example with cv2.undistort, and give the "
            "camera matrix without coefficients"
        )


def check_pinhole(values: Values, names: re.Pattern[str] = DISTORTIONS) -> None:
    """Raise an error if one of the values says that the camera is no pinhole without distortion."""
    for key, value in values.items():
        if MODELS.fullmatch(str(key).lower()):
            check_model(value)
        if "fisheye" in str(key).lower() and value:
            check_model("fisheye")
        if names.fullmatch(str(key).lower()):
            check_distortion(value, key)


def check_view(view: Values, image: Size) -> None:
    """Raise an error if a camera cannot be one of images of its size, or of the size `image`."""
    size = (view["width"], view["height"]) if "width" in view else image
    if size is None:
        return
    shown, focal = f"for images of {size[0]}x{size[1]} pixels", max(view["focal_px"])
    if focal < MIN_FOCAL * max(size):
        raise ReconstructionError(
            f"has a focal length of {focal:g} {shown}: it must be in pixels of these images"
        )
    centre = view.get("cx", 0), view.get("cy", 0)
    if not all(-1 <= x <= side for x, side in zip(centre, size, strict=True)):
        raise ReconstructionError(
            f"has the principal point ({centre[0]:g}, {centre[1]:g}) {shown}: it must lie inside; "
            "check the order and the unit of the numbers"
        )


def view_of(
    focal: Iterable[float], centre: Iterable[float], size: Iterable[Any] | None, first: float = 0.0
) -> dict[str, Any]:
    """Return the values of one view. The centre of the first pixel has the x and y `first`."""
    focal = [float(number) for number in focal]
    if not min(focal) > 0:
        raise ReconstructionError(f"has the focal length {min(focal):g}: it must be positive")
    values = {"focal_px": focal, **dict(zip(("cx", "cy"), (x - first for x in centre), strict=False))}
    return values | dict(zip(("width", "height"), map(int, size or ()), strict=False))


def pair(
    left: dict[str, Any], right: dict[str, Any] | None = None, baseline_mm: float | None = None
) -> dict[str, Any]:
    """Return a dictionary with the keys of calib.json for two views, or one for both."""
    return {**left, "left": left, "right": right or left, "baseline_mm": baseline_mm or None}


def only(views: Iterable[dict[str, Any]], image: Size) -> dict[str, Any]:
    """Return the only camera, where equal ones count as one, or the only one of the image's size."""
    different = list({repr(view): view for view in views}.values())
    if image is not None and len(different) > 1:
        of_size = [v for v in different if (v.get("width"), v.get("height")) == tuple(image)]
        different = of_size or different
    if len(different) != 1:
        number = f"{len(different)} different cameras: keep one" if different else "no cameras"
        raise ReconstructionError(f"has {number}")
    return pair(different[0])


def matrix_at(values: Values, keys: Iterable[str], *sizes: int) -> np.ndarray | None:
    """Return the first value at `keys` whose size is in `sizes`, as three rows, or else None."""
    for key in keys:
        value = values.get(key)
        data = value.get("data") if isinstance(value, Mapping) else value
        if data is not None and np.size(data) in sizes:
            return np.array(data, np.float64).reshape(3, -1)
    return None


def view_of_matrix(matrix: np.ndarray, size: Any = None) -> dict[str, Any]:
    """Return the values of one view for a (3, 3) camera matrix or a (3, 4) projection matrix."""
    left, first, last = matrix[:, :3], 0.0, np.array([0, 0, 1.0])
    if not np.allclose(left[2], last) and np.allclose(left[:, 2], last):
        left, first = left.T, 1.0
        warnings.warn(
            "the camera matrix is transposed, as MATLAB writes it: its principal point is read as "
            "in MATLAB, where the centre of the first pixel is (1, 1)",
            stacklevel=2,
        )
    if not np.allclose(left[2], last) or abs(left[1, 0]) > ROUNDING:
        rows = "; ".join(" ".join(f"{number:g}" for number in row) for row in left)
        raise ReconstructionError(f"has no camera matrix (fx 0 cx; 0 fy cy; 0 0 1), but {rows}")
    if abs(left[0, 1]) > ROUNDING * abs(left[0, 0]):
        check_distortion(float(left[0, 1]), "skew")
    (fx, _, cx), (_, fy, cy) = left[:2].tolist()
    return view_of((fx, fy), (cx, cy), size, first)


def camera_in(values: Values) -> dict[str, Any] | None:
    """Return the camera that the values of one object describe in the usual names, or None."""
    own = {re.sub("[_ ]", "", str(key)).lower(): value for key, value in values.items()}
    found: dict[str, list[float]] = {}
    for kind, choices in PAIRS.items():
        names = next((names for names in choices if {*names} & {*own}), ())
        found[kind] = numbers_in([own[name] for name in names if name in own])
        if len(names) == 2 and len(found[kind]) == 1 and kind != "size":
            raise ReconstructionError(f"has only one of {names[0]} and {names[1]}: add the other")
    focal, centre, size = found.values()
    matrix = matrix_at(values, MORE_MATRICES, 9)
    if matrix is None and not centre and len(focal) != 2:
        return None
    check_pinhole(values)
    if matrix is not None:
        return view_of_matrix(matrix, size[:2])
    for kind in ("focal length", "principal point"):
        if not found[kind]:
            names = ", ".join("".join(names[0]) for names in PAIRS[kind][:2])
            raise ReconstructionError(f"has no {kind} (such as {names}): add it in pixels")
    return view_of((focal * 2)[:2], centre, size)


def objects_in(values: Any, name: str = "") -> Iterator[tuple[str, Values]]:
    """Yield all objects of a file, outer ones first, each with the names that lead to it."""
    if isinstance(values, Mapping):
        yield name, values
    of_list = enumerate(values) if isinstance(values, list) else ()
    for key, value in values.items() if isinstance(values, Mapping) else of_list:
        yield from objects_in(value, f"{name} {key}".lower())


def plain(values: Any, image: Size, _: Any = None) -> dict[str, Any] | None:
    """Read any file with focal lengths and a principal point under their usual names."""
    found = []
    for name, each in objects_in(values):
        check_pinhole(each, COEFFICIENTS)
        if (camera := camera_in(each)) is not None:
            found.append((name, camera))
    sides = [[each for name, each in found if side in name] for side in ("left", "right")]
    if all(sides):
        left, right = (only(side, image)["left"] for side in sides)
        return pair(left, right)
    return only((camera for _, camera in found), image) if found else None


def orb_slam(values: Values, image: Size, _: Any) -> dict[str, Any] | None:
    """Read settings of ORB-SLAM or stella_vslam. Lengths are in metres, also in fx * baseline."""
    shared = values.get("Camera", {})
    if not isinstance(shared, Mapping):
        return None
    check_pinhole(shared)
    found = [each for key in ("Camera1", "Camera2") if (each := values.get(key))] or [shared]
    views = [camera_in({**shared, **each}) for each in found]
    if views[0] is None:
        raise ReconstructionError("has no focal length (fx, fy): add it in pixels")
    stereo, metres = values.get("Stereo", {}), None
    if re.search("depth_?map_?factor", str(values), re.IGNORECASE):
        return pair(views[0])  # a depth camera: the baseline is not between two of its images
    if product := shared.get("bf", shared.get("focal_x_baseline")):
        metres = float(product) / views[0]["focal_px"][0]
    elif "b" in stereo:
        metres = float(stereo["b"])
    elif "T_c1_c2" in stereo:
        metres = math.hypot(*numbers_in(stereo["T_c1_c2"])[3:12:4])
    return pair(views[0], views[-1], metres and metres * MM_PER_M)


def stella(values: Values, image: Size, _: Any) -> dict[str, Any] | None:
    """Read settings of OpenVSLAM or stella_vslam, which name the size cols and rows."""
    camera = values["Camera"]
    if not isinstance(camera, Mapping) or not {"model", "cols", "setup"} & {*camera}:
        return None
    return orb_slam(values, image, None)


def zed(values: Values, image: Size, _: Any) -> dict[str, Any]:
    """Read ZED's SN.conf, which has sections by image size, and the baseline in mm."""
    sizes = {name: size for name, size in ZED_SIZES.items() if f"LEFT_CAM_{name}" in values}
    name = next((each for each, size in sizes.items() if image in (None, size)), None)
    if name is None:
        known = ", ".join(f"{width}x{height}" for width, height in sizes.values())
        raise ReconstructionError(
            f"has no section for images of {'{}x{}'.format(*image or ())} pixels, only of {known}"
        )
    size = dict(zip(("width", "height"), sizes[name], strict=True))
    both = (values[f"{side}_CAM_{name}"] for side in ("LEFT", "RIGHT"))
    left, right = (camera_in({**size, **each}) for each in both)
    if left is None or right is None:
        raise ReconstructionError("has no focal length (fx, fy): download the file again")
    return pair(left, right, float(values["STEREO"]["Baseline"]))


def depthai(values: Values, image: Size, _: Any) -> dict[str, Any]:
    """Read DepthAI's calibration: left and right camera, or the only one. Lengths are in cm."""
    data = values["cameraData"]
    every = dict(data.items() if isinstance(data, Mapping) else data)
    every = {int(key): each for key, each in every.items() if any(numbers_in(each["intrinsicMatrix"]))}
    for each in every.values():
        if each.get("cameraType") == 1:
            check_model("fisheye")
    views = {key: camera_in(each) or {} for key, each in every.items()}
    stereo = values.get("stereoRectificationData", {})
    first, second = (stereo.get(f"{side}CameraSocket", -1) for side in ("left", "right"))
    if not {first, second} <= {*views}:
        first, second = 1, 2
    sizes = {key: (view.get("width"), view.get("height")) for key, view in views.items()}
    elsewhere = image in sizes.values() and sizes.get(first) != image
    if not {first, second} <= {*views} or elsewhere:
        return only(views.values(), image)
    length = 0.0
    for start, end in ((first, second), (second, first)):
        move = every[start].get("extrinsics", {})
        if move.get("toCameraSocket") == end:
            measured, planned = (numbers_in(move.get(k)) for k in ("translation", "specTranslation"))
            length = math.hypot(*measured) or math.hypot(*planned)
    return pair(views[first], views[second], length * MM_PER_CM)


def open3d(values: Values, image: Size, _: Any) -> dict[str, Any] | None:
    """Read Open3D's intrinsics or trajectory, where matrices are stored by columns."""
    found = [each for _, each in objects_in(values) if "intrinsic_matrix" in each]
    made = []
    for each in found:
        matrix = np.reshape(numbers_in(each["intrinsic_matrix"]), (3, 3))
        upright = matrix if np.allclose(matrix[2], (0, 0, 1)) else matrix.T
        made.append(camera_in({**each, "intrinsic_matrix": upright.tolist()}) or {})
    return only(made, image) if found else None


def opensfm(values: Values, image: Size, _: Any) -> dict[str, Any] | None:
    """Read OpenSfM's camera models: fractions of the longer side, from the middle of the image."""
    found = [each for _, each in objects_in(values) if "projection_type" in each]
    made = []
    for each in found:
        check_pinhole(each)
        size = (each["width"], each["height"]) if each.get("width") else None
        width, height = size or image or (1, 1)
        focal = (each["focal"],) * 2 if "focal" in each else (each["focal_x"], each["focal_y"])
        middle = np.array([width - 1, height - 1]) / 2
        centre = middle + np.multiply(max(width, height), (each.get("c_x", 0), each.get("c_y", 0)))
        made.append(view_of(np.multiply(max(width, height), focal), centre.tolist(), size))
    return only(made, image) if found else None


def openmvg(values: Values, image: Size, _: Any) -> dict[str, Any]:
    """Read OpenMVG's sfm_data.json. The centre of the first pixel is (0, 0)."""
    return plain(values["intrinsics"], image) or only([], image)


def meshroom(values: Values, image: Size, _: Any) -> dict[str, Any] | None:
    """Read Meshroom's cameras.sfm. The centre of the first pixel is (0, 0).

    Since version 1.2.1 the principal point is relative to half the width and half the height, since
    1.2.2 the focal length is in mm, and since 1.2.5 `pixelRatio` is fy / fx instead of fx / fy.
    """
    if not any("intrinsicId" in each for each in values["intrinsics"]):
        return None
    version, made = numbers_in(values["version"]), []
    for each in values["intrinsics"]:
        check_pinhole(each)
        width, height = float(each["width"]), float(each["height"])
        focal = numbers_in(each.get("pxFocalLength"))
        if not focal:
            focal = [float(each["focalLength"]) / float(each["sensorWidth"]) * width]
            ratio = float(each.get("pixelRatio", 1))
            focal.append(focal[0] * (ratio if version >= [1, 2, 5] else 1 / ratio))
        middle = (width / 2, height / 2) if version >= [1, 2, 1] else (0, 0)
        centre = np.add(numbers_in(each["principalPoint"]), middle).tolist()
        made.append(view_of((focal * 2)[:2], centre, (width, height)))
    return only(made, image)


def metashape(values: Values, image: Size, _: Any) -> dict[str, Any]:
    """Read Metashape's calibration or cameras. The centre of the first pixel is (0.5, 0.5).

    The principal point is relative to half the width and half the height. PhotoScan before 1.2 has
    fx and fy instead of f, and a principal point from the corner of the image.
    """
    root, made = values["metashape"], []
    sensors = [each.findall("calibration") for each in root.iter("sensor")]
    for found in [[root]] if root.tag == "calibration" else sensors:
        for node in sorted(found, key=lambda each: each.get("class") != "adjusted")[:1]:
            own = {**node.attrib, **{child.tag: child.text for child in node}}
            check_pinhole(own)
            resolution = node.find("resolution")
            size = own if resolution is None else resolution.attrib
            sides = np.array([int(size["width"]), int(size["height"])])
            middle = sides * (0.0 if "fx" in own else 0.5)
            if "fx" in own:
                focal = float(own["fx"]), float(own["fy"])
            else:
                focal = float(own["f"]) + float(own.get("b1", 0)), float(own["f"])
            centre = middle + [float(own.get(key) or 0) for key in ("cx", "cy")]
            made.append(view_of(focal, centre.tolist(), sides.tolist(), HALF_PIXEL))
    return only(made, image)


def bundler(values: Values, image: Size, _: Any) -> dict[str, Any]:
    """Read a file of Bundler, whose principal point is the middle of the image."""
    numbers, made = values["bundler"], []
    for start in range(2, 2 + 15 * int(numbers[0]), 15):  # f, k1, k2, rotation, translation
        focal, *distortion = numbers[start : start + 3]
        if focal:  # it is 0 for images without a pose
            check_distortion(distortion, "k1, k2")
            made.append(view_of((focal, focal), (), None))
    return only(made, image)


def matlab(values: Values, image: Size, _: Any) -> dict[str, Any]:
    """Read MATLAB's camera or stereo parameters. The centre of the first pixel is (1, 1)."""
    both = [values[key] for key in ("CameraParameters1", "CameraParameters2") if key in values]
    made = []
    for each in both or [values]:
        check_pinhole(each)
        size = numbers_in(each.get("ImageSize"))[::-1]
        matrix = np.reshape(numbers_in(each.get("IntrinsicMatrix", each.get("K"))), (3, 3))
        upright = matrix.T if np.allclose(matrix[:, 2], (0, 0, 1)) else matrix
        view = view_of_matrix(upright, size)
        made.append({**view, "cx": view["cx"] - 1, "cy": view["cy"] - 1})
    length = math.hypot(*numbers_in(values.get("TranslationOfCamera2")))
    unit = {"m": MM_PER_M, "meters": MM_PER_M, "mm": 1.0, "millimeters": 1.0}
    return pair(made[0], made[-1], length * unit.get(values.get("WorldUnits", "mm"), 0))


def nerfstudio(values: Values, image: Size, _: Any) -> dict[str, Any] | None:
    """Read transforms.json of nerfstudio or instant-ngp, whose frames may have own cameras."""
    made = []
    for frame in values.get("frames") or [{}]:
        own = {**values, **frame}
        check_pinhole(own)
        if not {"fl_x", "camera_angle_x"} & {*own}:
            raise ReconstructionError("has neither fl_x nor camera_angle_x: add fl_x in pixels")
        size = (own["w"], own["h"]) if "w" in own else None
        width, height = size or image or (1, 1)
        focal = own.get("fl_x") or width / 2 / math.tan(own["camera_angle_x"] / 2)
        down = own.get("fl_y") or focal
        if "camera_angle_y" in own and "fl_x" not in own:
            down = height / 2 / math.tan(own["camera_angle_y"] / 2)
        centre = (own["cx"], own["cy"]) if "cx" in own else ()
        made.append(view_of((focal, down), centre, size, HALF_PIXEL))
    return only(made, image)
