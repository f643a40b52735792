"""Formats of camera files: readers of the parsed files, and what all readers share.

A reader takes the parsed file and the image's (width, height), if known, and returns the values by
their usual names: cameras as objects with fx, fy, cx, cy or a matrix K, those of a pair as "left"
and "right" or with their poses, and "baseline_mm". It returns None for a file of another format.
`cameras_in` does the rest: it finds the cameras, checks them, and makes the keys of calib.json.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np

from .._shared.errors import ReconstructionError

Values = Mapping[str, Any]
Pair = tuple[int, int] | None

MM_PER_M = 1000.0
MM_PER_CM = 10.0

METRES_BELOW, MM_FROM = 1.0, 30.0
"""A baseline without a unit is taken as metres below METRES_BELOW, as mm from MM_FROM on. A number
between the two is left out: it may be in cm, or in chessboard squares as in OpenCV's example."""

ROUNDING = 1e-9
"""Distortion coefficients up to this count as 0 with a rounding error: even in the corner of a
large image, they would move a point by less than a ten-thousandth of a pixel."""

MIN_FOCAL = 0.1
"""A focal length under this fraction of the image's longer side is rejected as not being in pixels,
because the pinhole camera would have a field of view above 157 degrees."""

MATRIX_SIZE = 9
MATRIX = r"(?:new|color|rgb|cam(?:era)?)*(?:intrinsics?)?(?:matrix|mtx)|intrinsics?|cam|[km]"
PROJECTION = r"p|projection(?:matrix)?"
SIDES = ("left", "right"), ("l", "r"), ("1", "2"), ("0", "1")
FOCAL_LENGTHS = (
    *(("fx", "fy"), ("flx", "fly"), ("focalx", "focaly"), ("focallengthx", "focallengthy")),
    *(("focallength",), ("focal",), ("f",)),
)
CENTRES = ("cx", "cy"), ("ppx", "ppy"), ("principalpoint",)
SIZES = (
    *(("width", "height"), ("w", "h"), ("cols", "rows"), ("imagewidth", "imageheight")),
    *(("resolution",), ("imagedimension",)),
)
"""Names of matrices, focal lengths, principal points and image sizes, as `short` returns them."""
SIZE_NAMES = {name for names in SIZES for name in names}

MODELS = re.compile(r"(distortion)?(model|type)|modeltype|projection(type)?|poly.*name")
NO_PINHOLES = re.compile(
    r"fisheye|equi|spheric|cylind|omni|kannala|theta|panoram|unified|eucm|double|dual|division|"
    r"atan|orthogr|\b(ds|mei|fov|rpc|kb\d?)\b",
    re.IGNORECASE,
)
"""Camera models with one of these words in their name are refused, even without distortion."""

DISTORTIONS = re.compile(
    r"(?!num).*(distortion|disto(?!r)|dist(coef|param)|radial|tangential|kappa).*|(open|cv|rad)*dist|"
    r"coef\w*|[kpsd]\d|b2|skew|d|kc|xi|omega"
)
CROPS = re.compile(r"[xy]_offset|binning_[xy]")
BASELINES = re.compile(
    r"(?:stereo)?baseline(?:in)?(?:(mm|millimet\w+)|(cm|centimet\w+)|(m|met\w+))?"
)
"""Patterns of names of distortion coefficients, sensor crops and baselines (with their units)."""

ZED_SIZES = {
    **{"2K": (2208, 1242), "FHD": (1920, 1080), "FHD1200": (1920, 1200)},
    **{"HD": (1280, 720), "SVGA": (960, 600), "VGA": (672, 376)},
}
"""Sizes of images in pixels, by the names that the sections of ZED's files have for them."""


class Format(NamedTuple):
    """A file format: its name, a pattern that one of its keys matches, and its reader, if needed.

    `first` is the x and y of the first pixel's centre; None means 0, or 1 for MATLAB's transposed
    matrix. If it is "middle" or "fractions", principal points are relative to the image centre. If
    it is "fractions", these and the focal lengths are in fractions of the longer side.
    """

    name: str
    key: str
    read: Callable[[Values, Pair], Any] | None = None
    first: float | Literal["middle", "fractions"] | None = None


@lru_cache(maxsize=1000)
def short(key: Any) -> str:
    """Return a name in lower case, without blanks, underscores and the word camera at its start."""
    return re.sub(r"[_ ]|^cam(era)?[_ ]?(?=[a-z])(?!era)", "", str(key).lower())


def numbers_in(value: Any) -> list[float]:
    """Return the numbers of a text, nested list or object; [] for booleans and other text."""
    if isinstance(value, bytes) or (isinstance(value, str) and value.startswith("$base64$")):
        raise ReconstructionError("it has its numbers in base64: write it without base64")
    if isinstance(value, str):
        value = re.split(r"[\s,;\[\]]+", value.strip(" \t\r\n[];,"))
        try:
            return [float(word) for word in value]
        except ValueError:
            return []
    if isinstance(value, Mapping):
        return numbers_in(value["data"] if "data" in value else [*value.values()])
    if isinstance(value, list | tuple | np.ndarray):
        return [number for each in value for number in numbers_in(each)]
    return [] if value is None or isinstance(value, bool) else [float(value)]


def matrix_of(value: Any, *sizes: int) -> np.ndarray | None:
    """Return a matrix as three rows, or None if its number of elements is not in `sizes`."""
    nested = value[0] if isinstance(value, list) and value else value
    if isinstance(nested, Mapping) and "data" not in nested:
        return None
    numbers = numbers_in(value)
    if len(numbers) not in sizes:
        return None
    rows = np.reshape(numbers, (-1, 3 if len(numbers) == 9 else 4))[:3]
    by_columns = not isinstance(nested, list) and not rows[:2, 2].any() and rows[2, :2].any()
    return rows.T if by_columns else rows


def matrices(values: Values, name: str, *sizes: int) -> list[np.ndarray]:
    """Return the matrices whose keys say left and right; without such keys, the first matrix."""
    found: dict[str, np.ndarray] = {}
    for key, value in values.items():
        match = re.fullmatch(rf"(left|right|l|r)?({name})(left|right|l|r|[012])?", short(key))
        if match and (matrix := matrix_of(value, *sizes)) is not None:
            found.setdefault(match[1] or match[3] or "", matrix)
    pairs = ([found[left], found[right]] for left, right in SIDES if {left, right} <= {*found})
    return next(pairs, [*found.values()][:1])


def objects_in(values: Any, name: str = "") -> Iterator[tuple[str, Values]]:
    """Yield all objects of a file, outer ones first, each with the names that lead to it."""
    if isinstance(values, list):
        values = dict(enumerate(values))
    if isinstance(values, Mapping):
        yield name, values
        for key, value in values.items():
            yield from objects_in(value, f"{name} {key}".lower())


def in_mm(length: float, unit: float | None = None) -> float | None:
    """Convert a length to mm by its `unit` in mm, or a guess by its size; None if unclear or 0."""
    if unit is None:
        unit = MM_PER_M if length < METRES_BELOW else float(length >= MM_FROM)
        if not unit:
            warnings.warn(
                f"the baseline {length:g} has no unit and may be in mm or cm, so it is left out: "
                'call it "baseline_mm" and give it in mm, else lengths are in baselines',
                stacklevel=2,
            )
    return length * unit or None


def baseline_in(values: Values, pair: bool) -> float | None:
    """Return the baseline in mm that an object states, or None. A pair may state it as vector T."""
    for key, value in values.items():
        if match := BASELINES.fullmatch(short(key)):
            units = zip(match.groups(), (1.0, MM_PER_CM, MM_PER_M), strict=True)
            length = abs(sum(numbers_in(value)[:1]))
            return in_mm(length, next((unit for word, unit in units if word), None))
        if key == "T" and pair:
            return in_mm(math.hypot(*numbers_in(value)))
        if key in ("T_cn_cnm1", "T_c1_c2"):
            return in_mm(math.hypot(*numbers_in(value)[3:12:4]), MM_PER_M)
    return None


def check_pinhole(values: Values) -> None:
    """Raise an error if a value says that the camera has distortion or is not a pinhole."""
    for key, value in values.items():
        name = short(key)
        words = value.replace("_", " ") if isinstance(value, str) else ""
        fisheye = "fisheye" in name and value and numbers_in(value) != [0]
        if fisheye or (MODELS.fullmatch(name) and NO_PINHOLES.search(words)):
            raise ReconstructionError(
                f"it has a camera that is no pinhole ({key} {value!r}): undistort the images"
            )
        if key not in ("k", "p") and not DISTORTIONS.fullmatch(name):
            continue
        numbers = numbers_in(value)
        name = name if len(numbers) == 1 else name.rstrip("0123456789")  # K1 may be a matrix
        lens = DISTORTIONS.fullmatch(name) or (name in ("k", "p") and len(numbers) < MATRIX_SIZE)
        if lens and not all(abs(number) <= ROUNDING for number in numbers):
            raise ReconstructionError(
                f"it has distortion ({key} {', '.join(f'{n:g}' for n in numbers)}), which is not "
                "supported: undistort the images, for example with cv2.undistort, and give the "
                "camera matrix without coefficients"
            )


def check_whole(values: Values) -> None:
    """Raise an error if a value says that the camera's images are cropped or binned."""
    for key, value in values.items():
        least = str(key).startswith("binning")
        if CROPS.fullmatch(str(key)) and any(number > least for number in numbers_in(value)):
            raise ReconstructionError(
                f"it is for a part or a smaller copy of the camera's images ({key} {value}): "
                "give the calibration of these images"
            )


def _pair_at(values: Values, choices: Iterable[tuple[str, ...]]) -> list[float]:
    """Return two values, of the first keys in `choices` that exist (a single one twice), or []."""
    for names in choices:
        if numbers := [n for name in names for n in numbers_in(values.get(name))]:
            if len(numbers) < len(names):
                raise ReconstructionError(f"it lacks {names[0]} or {names[1]}: add the missing one")
            return (numbers * 2)[:2]
    return []


def _of_matrix(matrix: np.ndarray, first: Any) -> tuple[list[float], list[float], Any]:
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
    return [fx, fy], [cx, cy], first


def view_of(values: Values, image: Pair, form: Format) -> dict[str, Any] | None:
    """Convert an object with names such as fx and cx, or K, to a view with calib.json's keys.

    If the object describes no camera, None is returned.
    """
    own = {short(key): value for key, value in values.items()}
    first: Any = form.first
    focal, centre = _pair_at(own, FOCAL_LENGTHS), _pair_at(own, CENTRES)
    line = own.get("intrinsics")
    matrix = next(iter(matrices(values, MATRIX, 9, 12, 16)), None)
    if matrix is not None:
        focal, centre, first = _of_matrix(matrix, first)
    elif matrix_of(line, 4) is not None:  # fx, fy, cx, cy, as Kalibr has them
        focal, centre = numbers_in(line)[:2], numbers_in(line)[2:]
    corner = not isinstance(first, str)
    if not (focal and (centre or not corner)):
        if not centre and not {"fx", "flx", "focalx", "projectiontype"} & {*own}:
            return None
        missing = "principal point (cx, cy)" if focal else "focal length (fx, fy)"
        raise ReconstructionError(f"it has no {missing}: add it in pixels")
    size = _pair_at(own, SIZES)
    sides = np.array(size or image or (1, 1), np.float64)
    unit = sides.max() if first == "fractions" else 1.0
    focal = [unit * number for number in focal]
    x, y = unit * np.array(centre or (0, 0)) - ((1 - sides) / 2 if not corner else first or 0)
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
    return {"focal_px": focal, "cx": float(x), "cy": float(y), **shape}


def cameras_in(values: Any, image: Pair, form: Format) -> dict[str, Any] | None:
    """Return the cameras of a file in a dictionary with the keys of calib.json, or None.

    Rectified projection matrices are preferred to other matrices, and any matrix to single numbers.
    """
    found: list[tuple[str, dict[str, Any], list[float]]] = []
    length, distorted = None, False
    offset: list[float] = []
    unit: float | None = MM_PER_M
    for name, each in objects_in(values):
        rectified = [matrix for matrix in matrices(each, PROJECTION, 12) if matrix[0, 0] > 0]
        both = rectified or matrices(each, MATRIX, 9, 12, 16)
        check_whole(each)
        try:
            check_pinhole(each)
        except ReconstructionError:
            if not rectified:
                raise
            distorted = True
        size = {key: number for key, number in each.items() if short(key) in SIZE_NAMES}
        own = [{**size, "K": matrix} for matrix in both] if rectified or both[1:] else [each]
        for index, camera in enumerate(own):
            if view := view_of(camera, image, form):
                place = numbers_in(each.get("T_BS", each.get("T_SC")))[3:12:4]
                place = [-float(m[0, 3] / m[0, 0]) for m in rectified[index : index + 1]] or place
                found.append((name + (" left", " right")[index] * len(own[1:]), view, place))
        length = length or baseline_in(each, pair=bool(both[1:] and not rectified))
        unit = None if both[1:] else unit
        offset = offset or numbers_in(each.get("doffs"))
    if not found:
        return None
    sides = [[each for each in found if side in each[0]] for side in ("left", "right")]
    stereo = [len(side) for side in sides] == [1, 1]
    pair = sides[0] + sides[1] if stereo else found
    if len(pair) == 2 and not length and all(place for _, _, place in pair):
        places = [place for _, _, place in pair]
        if len(places[0]) == 1 and places[0] > places[1]:
            raise ReconstructionError(
                "it has its second camera to the left of its first: swap the two"
            )
        length = in_mm(math.dist(*places), unit)
    if distorted and len(found) == 1:
        warnings.warn(
            "the calibration has distortion, and the projection matrix that is read is of the "
            "images without it: give the rectified images (image_rect)",
            stacklevel=2,
        )
    views = [view for _, view, _ in found]
    fitting = [view for view in views if (view.get("width"), view.get("height")) == image] or views
    (_, left, _), (_, right, _) = pair[0], pair[-1]
    if left not in fitting or not (stereo or (length and len(pair) <= 2)):
        different = {repr(view): view for view in fitting}
        if len(different) > 1:
            raise ReconstructionError(
                f"it has {len(different)} different cameras: give a file with the one of the images"
            )
        left, right, length = fitting[0], fitting[0], None
    values = {"left": left, "right": right, "baseline_mm": length}
    return {**left, **values, "disparity_offset_px": offset[0] if offset else None}


def colmap(values: Values, image: Pair) -> Any:
    """Read the lines of COLMAP's cameras.txt."""
    cameras = []
    for model, numbers in values["COLMAP"]:
        width, height, *params = numbers_in(numbers)
        if model.startswith(("SIMPLE_", "RADIAL")):  # these models have a single focal length
            params.insert(0, params[0])
        size = {"model": model, "width": width, "height": height}
        cameras.append({**size, "intrinsics": params[:4], "coefficients": params[4:]})
    return dict(zip(("left", "right"), cameras, strict=True)) if len(cameras) == 2 else cameras


def dso(values: Values, image: Pair) -> Values:
    """Read camera.txt of DSO and LSD-SLAM; numbers under 1 are fractions of width and height.

    If the file does not name a model, a single fifth number other than 0 means a fisheye.
    """
    model, numbers, sides = values["DSO"]
    size, camera, more = numbers_in(sides), numbers_in(numbers)[:4], numbers_in(numbers)[4:]
    model = model or ("fov" if len(more) == 1 and more[0] else "pinhole")
    if max(camera[2:]) < 1:
        camera = (np.array(camera) * (*size, *size) - (0, 0, 0.5, 0.5)).tolist()
    return {"model": model, "intrinsics": camera, "coefficients": more, "resolution": size}


def kitti(values: Values, image: Pair) -> Values | None:
    """Read KITTI's P0 to P3 (odometry) or P_rect_00 to P_rect_03 (raw), by default 2 and 3."""
    found = {
        int(key[-1]): matrix
        for key, value in values.items()
        if re.fullmatch(r"P\d|P_rect_\d+", str(key))
        and (matrix := matrix_of(value, 12)) is not None
    }
    if not {0, 3} & {*found} and "P_rect_02" not in values:
        return None  # a file with only P1 and P2 is OpenCV's
    wanted = values.get("KITTI's views")
    only = next(iter(found))
    pairs = (each for each in (wanted, (2, 3), (0, 1)) if each and {*each} <= {*found})
    first, second = next(pairs, (only, only))
    if wanted and wanted != (first, second):
        warnings.warn(
            f"the images are of the cameras {wanted[0]} and {wanted[1]}, but the calibration lacks "
            f"one or both: its cameras {first} and {second} are used instead",
            stacklevel=2,
        )
    size = {"resolution": values.get(f"S_rect_0{first}")}
    left, right = ({**size, "P": found[number]} for number in (first, second))
    return {"left": left, "right": right} if first != second else left


def middlebury(values: Values, image: Pair) -> Values | None:
    """Read Middlebury's calib.txt, whose baseline is in mm."""
    return {"baseline_mm": values["baseline"], **values} if "baseline" in values else None


def orb_slam(values: Values, image: Pair) -> Any:
    """Read settings of ORB-SLAM or stella_vslam, with lengths in metres; bf is fx * baseline."""
    shared: Any = values.get("Camera", {})
    if not isinstance(shared, Mapping):
        return None
    found = [{**shared, **values[key]} for key in ("Camera1", "Camera2") if key in values]
    found, stereo = found or [dict(shared)], values.get("Stereo", {})
    if not {"fx", "type", "model", "bf"} & {*found[0]}:
        return None
    check_pinhole(found[0])
    metres = float(shared.get("bf", shared.get("focal_x_baseline", 0))) / float(found[0]["fx"])
    metres = metres or float(stereo.get("b", 0))
    metres = metres or math.hypot(*numbers_in(stereo.get("T_c1_c2"))[3:12:4])
    if re.search("depth_?map_?factor", str(values), re.IGNORECASE):
        metres = 0.0  # this baseline is between sensors of a depth camera
    return {"left": found[0], "right": found[-1], "baseline_mm": metres * MM_PER_M}


def zed(values: Values, image: Pair) -> Values:
    """Read ZED's SN.conf, which has a section for each image size, and the baseline in mm."""
    sizes = {name: size for name, size in ZED_SIZES.items() if f"LEFT_CAM_{name}" in values}
    name = next((name for name, size in sizes.items() if image in (None, size)), None)
    if name is None:
        known = ", ".join(f"{width}x{height}" for width, height in sizes.values())
        raise ReconstructionError(
            f"it has no section for this size of images, only for {known}: resize the images"
        )
    left, right = (
        {**values.get(f"{side}_DISTO", {}), **values[f"{side}_CAM_{name}"], "resolution": size}
        for side, size in (("LEFT", sizes[name]), ("RIGHT", sizes[name]))
    )
    return {"left": left, "right": right, "baseline_mm": values["STEREO"]["Baseline"]}


def depthai(values: Values, image: Pair) -> Values:
    """Read DepthAI's calibration: left, right and other cameras. Lengths are in cm."""
    data = values["cameraData"]
    cameras = {
        int(key): {**each, "fisheye": each.get("cameraType") == 1}
        for key, each in (data.items() if isinstance(data, Mapping) else data)
        if any(numbers_in(each["intrinsicMatrix"]))
    }
    rig = values.get("stereoRectificationData", {})
    ends = [rig.get(f"{side}CameraSocket", -1) for side in ("left", "right")]
    ends = ends if {*ends} <= {*cameras} else [1, 2]
    moves = [cameras.get(end, {}).get("extrinsics", {}) for end in ends]
    lengths = [
        math.hypot(*numbers_in(move.get(name)))
        for move in moves
        for name in ("translation", "specTranslation")
        if move.get("toCameraSocket") in ends
    ]
    names = dict(zip(ends, ("left", "right"), strict=True))
    found: dict[Any, Any] = {names.get(key, key): each for key, each in cameras.items()}
    return {**found, "baseline_cm": next(filter(None, lengths), 0.0)}


def opensfm(values: Values, image: Pair) -> Any:
    """Read OpenSfM's camera models or reconstruction."""
    return [each for _, each in objects_in(values) if "projection_type" in each] or None


def meshroom(values: Values, image: Pair) -> Any:
    """Read Meshroom's cameras.sfm.

    Since version 1.2.1 the principal point is relative to half the width and half the height, since
    1.2.2 the focal length is in mm, and since 1.2.5 `pixelRatio` is fy / fx instead of fx / fy.
    """
    if not any(isinstance(each, Mapping) and "type" in each for each in values["intrinsics"]):
        return None
    version, cameras = numbers_in(values["version"]), []
    for each in values["intrinsics"]:
        size = np.array([float(each["width"]), float(each["height"])])
        focal = numbers_in(each.get("pxFocalLength"))
        if not focal:
            fx = float(each["focalLength"]) / float(each["sensorWidth"]) * size[0]
            ratio = float(each.get("pixelRatio", 1))
            focal = [fx, fx * (ratio if version >= [1, 2, 5] else 1 / ratio)]
        centre = np.array(numbers_in(each["principalPoint"])) + size / 2 * (version >= [1, 2, 1])
        own = {"focal": focal, "principal_point": centre, "resolution": size}
        lens = {key: each[key] for key in each if key == "type" or "dist" in key.lower()}
        cameras.append({**own, **lens})
    return cameras


def metashape(values: Values, image: Pair) -> Any:
    """Read Metashape's calibration, or the cameras of a chunk; adjusted ones are preferred.

    Before version 1.2, PhotoScan had fx and fy, and measured cx and cy from the corner.
    """
    cameras = []
    for _, each in objects_in(values):
        if nodes := each.get("calibration"):
            nodes = nodes if isinstance(nodes, list) else [nodes]
            own = min(nodes, key=lambda node: node.get("class") != "adjusted")
            own = {**own, **own.get("resolution", {})}
            number = {key: sum(numbers_in(value)[:1]) for key, value in own.items()}
            if "fx" in own:
                own["cx"] = number["cx"] - number["width"] / 2
                own["cy"] = number["cy"] - number["height"] / 2
            else:
                own |= {"fx": number["f"] + number.get("b1", 0), "fy": number["f"]}
            cameras.append(own)
    return cameras


def bundler(values: Values, image: Pair) -> Any:
    """Read a file of Bundler: f, k1, k2, rotation and translation; f is 0 if no pose is known."""
    count, _, *numbers = values["bundler"]
    rows = np.reshape(numbers[: 15 * int(count)], (-1, 15)).tolist()
    return [{"f": row[0], "coefficients": row[1:3]} for row in rows if row[0]]


def nerfstudio(values: Values, image: Pair) -> Any:
    """Read transforms.json of nerfstudio or instant-ngp, where each frame may have its camera."""
    cameras = []
    for frame in values.get("frames") or [{}]:
        own = {**values, **frame, "frames": ()}
        if "fl_x" not in own and "camera_angle_x" not in own:
            raise ReconstructionError("it has neither fl_x nor camera_angle_x: add fl_x in pixels")
        size = np.array((own["w"], own["h"]) if "w" in own else image or (1, 1))
        angles = own.get("camera_angle_x"), own.get("camera_angle_y")
        fx, fy = (a and side / 2 / math.tan(a / 2) for a, side in zip(angles, size, strict=True))
        fx, fy = own.get("fl_x") or fx, own.get("fl_y") or own.get("fl_x") or fy or fx
        centre = (own["cx"], own["cy"]) if "cx" in own else size / 2
        cameras.append({**own, "fx": fx, "fy": fy, **dict(zip(("cx", "cy"), centre, strict=True))})
    return cameras


def matlab(values: Values, image: Pair) -> Values:
    """Read a structure of MATLAB's cameraParameters or stereoParameters; lengths are in mm."""
    both = [values[key] for key in values if re.fullmatch(r"Camera(Parameters)?[12]", str(key))]
    found = [
        {**each, "resolution": numbers_in(each.get("ImageSize"))[::-1]} for each in both or [values]
    ]
    length = math.hypot(*numbers_in(values.get("TranslationOfCamera2")))
    return {"left": found[0], "right": found[-1], "baseline_mm": length}


FORMATS = (
    Format("COLMAP's list of cameras", "COLMAP", colmap, 0.5),
    Format("DSO's calibration", "DSO", dso),
    Format("KITTI's calibration", r"P\d|P_rect_\d+", kitti),
    Format("Middlebury's calibration", "cam0", middlebury),
    Format("nerfstudio's transforms.json", "fl_x|camera_angle_x|frames", nerfstudio, 0.5),
    Format("EuRoC's sensor.yaml", "T_BS"),
    Format("Kalibr's calibration", "cam0|camera_model"),
    Format("MATLAB's calibration", r"IntrinsicMatrix|RadialDistortion|\w+OfCamera2", matlab, 1.0),
    Format("ORB-SLAM's or stella_vslam's calibration", "Camera1?", orb_slam),
    Format("ZED's calibration", r"LEFT_CAM_\w+", zed),
    Format("RealSense's calibration", "ppx"),
    Format("DepthAI's calibration", "cameraData", depthai),
    Format("Open3D's camera", "intrinsic_matrix|intrinsic|parameters", None, 0.0),
    Format("OpenMVG's calibration", "sfm_data_version", lambda own, _: own["intrinsics"], 0.0),
    Format("Meshroom's calibration", "intrinsics", meshroom, 0.0),
    Format("Metashape's calibration", "metashape", metashape, "middle"),
    Format("Bundler's file", "bundler", bundler, "middle"),
    Format("OpenSfM's list of cameras", ".*", opensfm, "fractions"),
    Format("camodocal's or VINS's calibration", r"(projection|mirror)_parameters"),
    Format("ROS's calibration", r"distortion_model|projection_matrix|camera_name|D|d"),
    Format("OpenCV's calibration", r"[MKP]1|cameraMatrix\w*|camera_matrix|distCoeffs"),
    Format("the file", ".*"),
)
"""The formats, in the order in which they are tried."""
