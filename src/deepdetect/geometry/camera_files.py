"""Reading of camera files: parsing, and the choice of the format by the content of the file.

`camera_formats` has the readers. The result is a dictionary with the keys of calib.json, which the
module `camera` describes.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from .._shared.errors import ReconstructionError
from .camera_formats import FORMATS, Pair, Values, cameras_in, numbers_in

FILES_OF_PAIRS = (
    *(("left.yaml", "right.yaml"), ("intrinsics.yml", "extrinsics.yml")),
    *(("cam0/sensor.yaml", "cam1/sensor.yaml"), ("mav0/cam0/sensor.yaml", "mav0/cam1/sensor.yaml")),
)
"""Names of the two files that ROS, OpenCV or EuRoC write to a folder for a stereo pair."""

NUMBERS = r"([-+.\deE \t;,\[\]]+)\r?$"
COLMAP_LINE = re.compile(rf"^[ \t]*\d+[ \t]+([A-Z_]+)[ \t]{NUMBERS}", re.MULTILINE)
DSO_FILE = re.compile(
    rf"^(?:([A-Za-z]\w*)[ \t]+)?{NUMBERS}\n[ \t]*(\d+[ \t]+\d+)[ \t\r]*$", re.MULTILINE
)
TEXT_LINE = re.compile(r"(\[?)([^]:=[]*[A-Za-z][^]:=[]*)\]?(?:([:=])\s*(.*))?")

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
    the left and right camera in KITTI's files, which hold several cameras. The key "format" of the
    result names the format.

    Raises:
        ReconstructionError: the format is unknown, or the cameras have distortion.
        OSError: the file cannot be read. Any other exception means that the file is damaged.
    """
    if not path.is_dir():
        values = _parsed(path.read_bytes())
        return _calib_json({**values, "KITTI's views": views} if views else values, image)
    for names in FILES_OF_PAIRS:
        if all((path / name).is_file() for name in names):
            first, second = (_parsed((path / name).read_bytes()) for name in names)
            merged = names[1] == "extrinsics.yml"
            both = {**first, **second} if merged else {"left": first, "right": second}
            return _calib_json(both, image)
    wanted = ", or ".join(" and ".join(names) for names in FILES_OF_PAIRS)
    raise ReconstructionError(f"the folder does not contain {wanted}: give a file")


def _parsed(content: bytes) -> Values:
    """Parse a camera file, without `cv2.FileStorage`, which hangs or crashes on damaged files."""
    if b"\0" in content:
        raise ReconstructionError(f"it is no text: {KNOWN}")
    text = content.decode("utf-8", "replace").lstrip("\ufeff \r\n\t")
    if text.startswith("<"):
        root = ElementTree.fromstring(text)
        values = _xml_values(root)
        ours = root.tag in ("calibration", "document", "chunk")
        return {"metashape": {root.tag: values}} if ours else values
    if text.startswith("# Bundle file"):
        return {"bundler": numbers_in(text.partition("\n")[2])}
    lines = re.sub(r"^[ \t]*(#|//).*$", "", text, flags=re.MULTILINE).strip()
    if numbers := numbers_in(lines):
        broken = "\n" in lines or 0 in numbers[:4]
        if len(numbers) in (9, 12, 16) and broken:
            columns = 3 if len(numbers) == 9 else 4
            rows = [numbers[start : start + columns] for start in range(0, len(numbers), columns)]
            return {"matrix": rows}
        if len(numbers) not in range(4, 10) or broken:
            raise ReconstructionError(f"it holds {len(numbers)} numbers: {KNOWN}")
        return {"intrinsics": numbers[:4], "coefficients": numbers[4:]}
    if cameras := COLMAP_LINE.findall(text):
        return {"COLMAP": cameras}
    if (match := DSO_FILE.match(lines)) and len(numbers_in(match[2])) > 4:
        return {"DSO": [*match.groups()]}
    try:
        values = json.loads(text) if text[:1] in ("{", "[") else None
    except ValueError:
        if text[0] == "{":
            raise
        values = None
    if values is None:
        values = _yaml(text)
    if isinstance(values, list) and any(isinstance(each, Mapping) for each in values):
        values = dict(enumerate(values))  # YAML reads "[section]" as a list
    values = values if isinstance(values, dict) else _text(lines)
    if not values and text[:1] != "{":
        raise ReconstructionError(f"it holds no cameras: {KNOWN}")
    return values


def _yaml(text: str) -> Any:
    """Parse YAML with OpenCV's tags, or return None. A key "Camera.fx" becomes "fx" in "Camera"."""
    import yaml

    Loader: Any = type("Loader", (yaml.SafeLoader,), {})  # a subclass, to accept OpenCV's tags
    Loader.add_multi_constructor("", lambda loader, _, node: loader.construct_mapping(node, True))
    # ROS ends its file with the start of a second YAML document, so only the first one is read.
    body = re.sub(r"\A%YAML[^\n]*\n", "", text).replace("\t", " ")
    body = re.sub(
        r"^( *[\w.]+):(?=[-.\d[])", r"\1: ", body, flags=re.MULTILINE
    )  # OpenCV reads "key:1" like "key: 1"
    try:
        values: Any = next(yaml.load_all(body, Loader), None)
    except yaml.YAMLError:
        if text.startswith("%YAML"):
            raise
        return None
    for key in [*values] if isinstance(values, dict) else ():
        head, dot, tail = str(key).partition(".")
        if dot and isinstance(of_head := values.setdefault(head, {}), dict):
            of_head[tail] = values[key]
    return values


def _text(lines: str) -> Values:
    """Parse lines "name = value" or "name: value", under [sections], or numbers under a name."""
    values: dict[str, Any] = {}
    section, name = values, ""
    for line in map(str.strip, re.split(r"\n|[,;](?=\s*[A-Za-z]\w*\s*[:=])", lines)):
        if numbers := numbers_in(line):
            if name:
                section[name] = [*section.get(name, []), *numbers]
        elif not line:
            name = name if name not in section else ""
        elif match := TEXT_LINE.fullmatch(line):
            start, key, sign, value = match.groups()
            key, value = key.strip(), (value or "").strip()
            if start or (sign and value and name and name not in section):
                section = values.setdefault(key if start else name, {})
            if sign and value and key in section:  # a repeated key starts the next camera
                section = values.setdefault(f"{len(values)}", {})
            if sign and value:
                section[key] = numbers_in(value) or value
            name = "" if start or value else key
    if isinstance(size := values.get("image"), dict):  # ROS's ost.txt has the size in this section
        values = {key: {**size, **each} for key, each in values.items() if isinstance(each, dict)}
    return values


def _xml_values(node: ElementTree.Element) -> Any:
    if node.get("type_id") == "binary":
        return b""
    if not len(node) and (text := (node.text or "").strip()):
        return numbers_in(text) or text
    values: dict[str, Any] = dict(node.attrib)
    for child in node:
        value = _xml_values(child)
        values[child.tag] = [values[child.tag], value] if child.tag in values else value
    return values


def _calib_json(values: Values, image: Pair) -> dict[str, Any]:
    sides = [each for key in ("left", "right") if isinstance(each := values.get(key), Mapping)]
    names = {key for each in (values, *sides) for key in each}
    if "focal_px" in names or ("baseline_mm" in names and names <= {*OWN_KEYS}) or not values:
        for key, value in [item for each in (values, *sides) for item in each.items()]:
            if key not in OWN_KEYS and not isinstance(value, Mapping) and any(numbers_in(value)):
                known = ", ".join(OWN_KEYS)
                raise ReconstructionError(
                    f"its key {key!r} is not known: use {known}, for images without distortion"
                )
        return dict(values)
    whose = "it"
    for form in FORMATS:
        if any(re.fullmatch(form.key, str(each)) for each in values):
            try:
                own = form.read(values, image) if form.read else values
                if own is not None and (found := cameras_in(own, image, form)):
                    return {**found, "format": form.name}
                whose = whose if own in (None, values) else form.name
            except ReconstructionError as error:
                raise ReconstructionError(form.name + str(error).removeprefix("it")) from None
            except KeyError as error:
                raise ReconstructionError(f"{form.name} has no {error.args[0]}: add it") from None
    keys = ", ".join(map(str, [*values][:5]))
    raise ReconstructionError(f"{whose} has no cameras, only the keys {keys}: {KNOWN}")
