"""Reading of camera files: parsing, the table of formats, and OpenCV, ROS, KITTI and their like.

A format is recognised by the content of the file. All readers return a dictionary with the keys of
calib.json, which the module `camera` describes; `camera_formats` has the readers of other families.
"""

from __future__ import annotations

import configparser
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from .._shared.errors import ReconstructionError
from . import camera_formats as formats
from .camera_formats import MM_PER_M, Format, Found, Pair, Values, matrix_at, numbers_in

STEREO = (
    *(("P1", "P2", ""), ("M1", "M2", "D"), ("K1", "K2", "D")),
    ("cameraMatrix1", "cameraMatrix2", "distCoeffs"),
)
"""Keys in OpenCV's files. A row has the keys of the left and the right camera matrix, and those of
the distortion coefficients without the final 1 or 2. The first row is for rectified views."""

PROJECTIONS = ("projection_matrix", "P", "p")
FILES_OF_PAIRS = (
    *(("left.yaml", "right.yaml"), ("intrinsics.yml", "extrinsics.yml")),
    *(("cam0/sensor.yaml", "cam1/sensor.yaml"), ("mav0/cam0/sensor.yaml", "mav0/cam1/sensor.yaml")),
)
"""Names of the two files that ROS, OpenCV or EuRoC write to a folder for a stereo pair."""

MIN_BASELINE_MM = 10.0
"""OpenCV's files do not state the unit of lengths. A baseline is taken to be in metres if its
number is smaller than this, else in mm. Chosen by hand."""

NUMBERS = r"([-+.\deE \t;,\[\]]+)\r?$"
COLMAP_LINE = re.compile(rf"^[ \t]*\d+[ \t]+([A-Z_]+)[ \t]{NUMBERS}", re.MULTILINE)
TEXT_LINE = re.compile(rf"^[ \t]*(\w+)[ \t]*[:=]{NUMBERS}", re.MULTILINE)

SIZES = "image_width", "image_height", "width", "height", "resolution"

OWN_KEYS = (
    *("focal_px", "cx", "cy", "width", "height", "baseline_mm", "disparity_offset_px"),
    *("left", "right"),
)

KNOWN = (
    "give a file of a program that docs/files.md lists, a matrix of 3x3 numbers, or JSON such as "
    '{"focal_px": 1000, "cx": 320, "cy": 240, "baseline_mm": 120}'
)


def read_camera_file(path: Path, image: Pair = None, views: Pair = None) -> dict[str, Any]:
    """Read a camera file, or a folder with two; return a dictionary with the keys of calib.json.

    `image` is the (width, height) of the first image, if it is known, and `views` the numbers of
    left and right camera in KITTI's files, which have several. The key "format" of the result says
    whose file it is.

    Raises:
        ReconstructionError: the format is unknown, or the cameras have distortion.
        OSError: the file cannot be read. Any other exception means that the file is damaged.
    """
    if not path.is_dir():
        return _calib_json(_parsed(path.read_bytes()), image, views)
    for names in FILES_OF_PAIRS:
        if all((path / name).is_file() for name in names):
            first, second = (_parsed((path / name).read_bytes()) for name in names)
            if names[1] == "extrinsics.yml":
                return _calib_json({**first, **second}, image, views)
            left, right = (_calib_json(each, image, None) for each in (first, second))
            return {**left, "right": right["right"], "baseline_mm": _distance(first, second)}
    wanted = ", or ".join(" and ".join(names) for names in FILES_OF_PAIRS)
    raise ReconstructionError(f"the folder does not contain {wanted}: give a file")


def _parsed(content: bytes) -> Values:
    """Parse a camera file, without `cv2.FileStorage`, which hangs or crashes on damaged files."""
    text = content.decode("utf-8", "replace").lstrip("\ufeff \r\n\t")
    if text.startswith("<"):
        root = ElementTree.fromstring(text)
        ours = root.tag in ("calibration", "document", "chunk")
        return {"metashape": root} if ours else _xml_values(root)
    if text.startswith("# Bundle file"):
        return {"bundler": _numbers(text.partition("\n")[2])}
    lines = re.sub(r"^[ \t]*(#|//).*$", "", text, flags=re.MULTILINE).strip()
    if numbers := _numbers(lines):
        numbers = numbers[:12] if numbers[12:] == [0, 0, 0, 1] else numbers
        broken = "\n" in lines or 0 in numbers[1:4:2]
        if len(numbers) not in (*range(4, 10), 12) or (len(numbers) == 4 and broken):
            raise ReconstructionError(f"it holds {len(numbers)} numbers: {KNOWN}")
        if len(numbers) == 12 or (len(numbers) == 9 and broken):
            return {"matrix": numbers}
        return {"intrinsics": numbers[:4], "coefficients": numbers[4:]}
    if cameras := COLMAP_LINE.findall(text):
        return {"COLMAP": [(model, _numbers(numbers)) for model, numbers in cameras]}
    found = {key: _numbers(numbers) for key, numbers in TEXT_LINE.findall(text)}
    if any(re.fullmatch(r"P\d|P_rect_\d+|cam[01]", key) for key in found):
        return found
    if re.match(r"\[\w+\]\s*$|\w+[ \t]*=", lines, re.MULTILINE):
        parser = configparser.ConfigParser(strict=False, interpolation=None)
        parser.optionxform = str  # type: ignore[assignment,method-assign]
        parser.read_string(lines if lines.startswith("[") else f"[camera]\n{lines}")
        return {name: dict(parser[name]) for name in parser.sections()}
    values = json.loads(text) if text[:1] in ("{", "[") else _yaml(text)
    if isinstance(values, list):
        values = dict(enumerate(values))
    if not isinstance(values, dict):
        raise ReconstructionError(f"it holds no cameras: {KNOWN}")
    return values


def _yaml(text: str) -> Any:
    """Parse YAML, with OpenCV's tags. "Camera.fx: 500" becomes an object "Camera" with "fx"."""
    import yaml

    Loader: Any = type("Loader", (yaml.SafeLoader,), {})  # a subclass, to accept OpenCV's tags
    Loader.add_multi_constructor("", lambda loader, _, node: loader.construct_mapping(node, True))
    # ROS ends its file with the start of a second YAML document, so only the first one is read.
    text = re.sub(r"\A%YAML[^\n]*\n", "", text).replace("\t", " ")
    text = re.sub(
        r"^( *[\w.]+):(?=[-.\d[])", r"\1: ", text, flags=re.MULTILINE
    )  # as OpenCV reads it
    values: Any = next(yaml.load_all(text, Loader), None)
    for key in [*values] if isinstance(values, dict) else ():
        head, dot, tail = str(key).partition(".")
        if dot and isinstance(of_head := values.setdefault(head, {}), dict):
            of_head[tail] = values[key]
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


def _metres(left: np.ndarray, right: np.ndarray) -> float | None:
    """Return the distance between the cameras of two projection matrices; None if not known."""
    if left.shape[1] < 4 or right.shape[1] < 4:
        return None
    distance = float(left[0, 3] / left[0, 0] - right[0, 3] / right[0, 0])
    if distance < 0:
        raise ReconstructionError("it has its second camera to the left of its first: swap the two")
    return distance or None


def _distance(first: Values, second: Values) -> float | None:
    """Return the baseline in mm from two camera poses (EuRoC) or two projection matrices (ROS)."""
    if "T_BS" in first and "T_BS" in second:
        left, right = (np.reshape(each["T_BS"]["data"], (4, 4))[:3, 3] for each in (first, second))
        return float(np.linalg.norm(left - right)) * MM_PER_M
    p0, p1 = (matrix_at(each, PROJECTIONS, 12) for each in (first, second))
    distance = None if p0 is None or p1 is None else _metres(p0, p1)
    return distance and distance * MM_PER_M


def _matrices(values: Values, matrices: Iterable[np.ndarray], baseline_mm: float | None) -> Found:
    """Return cameras of the size that the values state, without their distortion."""
    size = {key: values[key] for key in SIZES if key in values}
    return Found([{**size, "K": matrix} for matrix in matrices], True, baseline_mm)


def _colmap(values: Values, image: Pair) -> Found:
    cameras = []
    for model, (width, height, *numbers) in values["COLMAP"]:
        if model.startswith(("SIMPLE_", "RADIAL")):  # these models have a single focal length
            numbers.insert(0, numbers[0])
        size = {"model": model, "width": width, "height": height}
        cameras.append({**size, "intrinsics": numbers[:4], "coefficients": numbers[4:]})
    return Found(cameras, len(cameras) == 2)


def _kitti(values: Values, image: Pair) -> Found | None:
    """Read KITTI's P0 to P3 (odometry) or P_rect_00 to P_rect_03 (raw), by default 2 and 3."""
    for start in ("P", "P_rect_0"):
        for first, second in (values["views"] or (2, 3), (2, 3), (0, 1)):
            left, right = (matrix_at(values, [f"{start}{n}"], 12) for n in (first, second))
            if left is not None and right is not None:
                distance = _metres(left, right)
                size = {"resolution": values.get(f"S_rect_0{first}")}
                return _matrices(size, (left, right), distance and distance * MM_PER_M)
    return None


def _middlebury(values: Values, image: Pair) -> Found | None:
    left, right = (matrix_at(values, [key], 9) for key in ("cam0", "cam1"))
    if left is None or right is None:
        return None
    if offset := values.get("doffs"):
        right[0, 2] = left[0, 2] + offset[0]
    return _matrices(values, (left, right), values.get("baseline", [None])[0])


def _kalibr(values: Values, image: Pair) -> Found | None:
    """Read a camera chain of Kalibr, or a file with one camera, such as EuRoC's sensor.yaml."""
    found = [each for key in ("cam0", "cam1") if isinstance(each := values.get(key), Mapping)]
    cameras = found or [values]
    if not all({"camera_model", "intrinsics"} <= {*camera} for camera in cameras):
        return None
    move = np.array(cameras[-1].get("T_cn_cnm1", np.eye(4)), np.float64)
    return Found(cameras, True, float(np.linalg.norm(move[:3, 3])) * MM_PER_M)


def _opencv(values: Values, image: Pair) -> Found | None:
    """Read a file of OpenCV or ROS. If it has distortion, it also needs rectified projections."""
    for first, second, distortion in STEREO:
        left, right = (matrix_at(values, [key], 9, 12) for key in (first, second))
        if left is not None and right is not None:
            for number in "12" if distortion else "":
                formats.check_pinhole({"d": values.get(distortion + number)})
            move = matrix_at(values, ["T"], 3)
            length = _metres(left, right)
            length = float(np.linalg.norm(move)) if length is None and move is not None else length
            unit = MM_PER_M if length and length < MIN_BASELINE_MM else 1.0
            return _matrices(values, (left, right), length and length * unit)
    matrix, projection = (
        matrix_at(values, formats.MATRICES, 9, 12),
        matrix_at(values, PROJECTIONS, 12),
    )
    if projection is not None and projection[0, 0] > 0:
        return _matrices(values, (projection,), None)
    return None if matrix is None else Found([values])


FORMATS = (
    Format("COLMAP's list of cameras", "COLMAP", _colmap, 0.5),
    Format("KITTI's calibration", r"P\d|P_rect_0\d", _kitti),
    Format("Middlebury's calibration", "cam0", _middlebury),
    Format("EuRoC's sensor.yaml", "T_BS", _kalibr),
    Format("Kalibr's calibration", "cam0|camera_model", _kalibr),
    Format("ORB-SLAM's or stella_vslam's calibration", "Camera1?", formats.orb_slam),
    Format("ZED's calibration", r"LEFT_CAM_\w+", formats.zed),
    Format("RealSense's calibration", "ppx", formats.plain),
    Format("DepthAI's calibration", "cameraData", formats.depthai),
    Format("Open3D's camera", "intrinsic_matrix|intrinsic|parameters", formats.plain, 0.0),
    Format("OpenMVG's calibration", "sfm_data_version", formats.openmvg, 0.0),
    Format("Meshroom's calibration", "intrinsics", formats.meshroom, 0.0),
    Format("Metashape's calibration", "metashape", formats.metashape, 0.0, "middle"),
    Format("Bundler's file", "bundler", formats.bundler, 0.0, "middle"),
    Format("MATLAB's calibration", "IntrinsicMatrix|RadialDistortion", formats.plain, 1.0),
    Format("nerfstudio's transforms.json", "fl_x|camera_angle_x|frames", formats.nerfstudio, 0.5),
    Format("OpenSfM's list of cameras", ".*", formats.opensfm, 0.0, "fractions"),
    Format("the file", "matrix", _opencv),
    Format("ROS's calibration", "distortion_model|camera_name|projection_matrix", _opencv),
    Format("OpenCV's calibration", ".*", _opencv),
    formats.ANY,
)
"""The formats, in the order in which they are tried."""


def _calib_json(values: Values, image: Pair, views: Pair) -> dict[str, Any]:
    sides = [each for key in ("left", "right") if isinstance(each := values.get(key), Mapping)]
    if not values or any({"focal_px", "baseline_mm"} & {*each} for each in (values, *sides)):
        for key, value in [item for each in (values, *sides) for item in each.items()]:
            if key not in OWN_KEYS and not isinstance(value, Mapping) and any(numbers_in(value)):
                known = ", ".join(OWN_KEYS)
                raise ReconstructionError(
                    f"its key {key!r} is not known: use {known}, for images without distortion"
                )
        return dict(values)
    names = []
    for form in FORMATS:
        if any(re.fullmatch(form.key, str(each)) for each in values):
            names += [form.name] if form.key != ".*" else []
            try:
                found = form.read(
                    {**values, "views": views} if form.read is _kitti else values, image
                )
                if found is not None:
                    return {**_cameras(found, image, form), "format": form.name}
            except ReconstructionError as error:
                raise ReconstructionError(form.name + str(error).removeprefix("it")) from None
            except KeyError as error:
                raise ReconstructionError(f"{form.name} has no {error.args[0]}: add it") from None
    keys = ", ".join(map(str, [*values][:5]))
    raise ReconstructionError(f"{[*names, 'it'][0]} has no cameras, only the keys {keys}: {KNOWN}")


def _cameras(found: Found, image: Pair, form: Format) -> dict[str, Any]:
    """Return a dictionary with the keys of calib.json for the cameras of a file."""
    views = [view for each in found.cameras if (view := formats.view_of(each, image, form))]
    fitting = [v for v in views if (v.get("width"), v.get("height")) == image]
    if found.stereo and (not fitting or views[0] in fitting):
        baseline_mm = found.baseline_mm or None
        return {**views[0], "left": views[0], "right": views[:2][-1], "baseline_mm": baseline_mm}
    different = list({repr(view): view for view in fitting or views}.values())
    if len(different) != 1:
        number = f"{len(different)} different cameras" if different else "no cameras"
        raise ReconstructionError(f"it has {number}: give a file with that of these images")
    return {**different[0], "left": different[0], "right": different[0]}
