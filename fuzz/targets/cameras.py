"""Calibrations of other programs: each is written for a camera that is known, and read again."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from deepdetect import DeepDetectError
from deepdetect.geometry.camera import Calibration

from ..case import Target, Wrong, expect

Numbers = tuple[int, int, float, float, float, float, float]
"""Width, height, focal lengths, principal point in our pixels, and one coefficient k1."""


def _json(*keys: str, shift: float = 0.0) -> Callable[[Numbers], str]:
    """Return a writer of one JSON object with keys for fx, fy, cx, cy, k1, width and height."""

    def write(n: Numbers) -> str:
        values = (n[2], n[3], n[4] + shift, n[5] + shift, n[6], n[0], n[1])
        return json.dumps(dict(zip(keys, values, strict=True)))

    return write


def _opensfm(n: Numbers) -> str:
    w, h, fx, fy, cx, cy, k1 = n
    side = max(w, h)
    centre = {"c_x": (cx - (w - 1) / 2) / side, "c_y": (cy - (h - 1) / 2) / side}
    values = {"projection_type": "brown", "width": w, "height": h, "k1": k1, **centre}
    return json.dumps({"v2": {**values, "focal_x": fx / side, "focal_y": fy / side}})


def _meshroom(n: Numbers) -> str:
    w, h, fx, fy, cx, cy, k1 = n
    sensor = {"sensorWidth": "36", "focalLength": repr(fx * 36 / w), "pixelRatio": repr(fy / fx)}
    sides = {"width": str(w), "height": str(h), "type": "radial1", "intrinsicId": "1"}
    centre = {
        "principalPoint": [repr(cx - w / 2), repr(cy - h / 2)],
        "distortionParams": [repr(k1)],
    }
    return json.dumps({"version": ["1", "2", "6"], "intrinsics": [{**sides, **sensor, **centre}]})


def _openmvg(n: Numbers) -> str:
    w, h, fx, fy, cx, cy, k1 = n
    data = {"width": w, "height": h, "focal_length": [fx, fy], "principal_point": [cx, cy]}
    value = {"ptr_wrapper": {"id": 1, "data": {**data, "disto_k3": [k1, 0, 0]}}}
    return json.dumps({"sfm_data_version": "0.3", "intrinsics": [{"key": 0, "value": value}]})


def _metashape(n: Numbers) -> str:
    w, h, fx, fy, cx, cy, k1 = n
    values = {"width": w, "height": h, "f": fy, "b1": fx - fy, "k1": k1}
    values |= {"cx": cx - (w - 1) / 2, "cy": cy - (h - 1) / 2}
    inner = "".join(f"<{key}>{value!r}</{key}>" for key, value in values.items())
    return f"<calibration><projection>frame</projection>{inner}</calibration>"


def _depthai(n: Numbers) -> str:
    w, h, fx, fy, cx, cy, k1 = n
    camera = {"intrinsicMatrix": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], "width": w, "height": h}
    return json.dumps({"cameraData": [[1, {**camera, "distortionCoeff": [k1] + [0.0] * 13}]]})


def _open3d(n: Numbers) -> str:
    columns = [n[2], 0, 0, 0, n[3], 0, n[4], n[5], 1]
    more = {"coeffs": [n[6]]}
    return json.dumps({"width": n[0], "height": n[1], "intrinsic_matrix": columns, **more})


def _slam(start: str, size: tuple[str, str]) -> Callable[[Numbers], str]:
    def write(n: Numbers) -> str:
        keys = ("fx", "fy", "cx", "cy", "k1", *size)
        values = (*n[2:], n[0], n[1])
        lines = (f"{start}{key}: {value!r}\n" for key, value in zip(keys, values, strict=True))
        return "%YAML:1.0\n" + ("Camera:\n" if start == "  " else "") + "".join(lines)

    return write


WRITERS: tuple[Callable[[Numbers], str], ...] = (
    _json("fx", "fy", "cx", "cy", "k1", "width", "height"),
    _json("fx", "fy", "ppx", "ppy", "coeffs", "width", "height"),
    _json("fl_x", "fl_y", "cx", "cy", "k1", "w", "h", shift=0.5),
    *(_opensfm, _meshroom, _openmvg, _metashape, _depthai, _open3d),
    *(_slam("Camera.", ("width", "height")), _slam("  ", ("cols", "rows"))),
    lambda n: (
        f"1 OPENCV {n[0]} {n[1]} {n[2]!r} {n[3]!r} {n[4] + 0.5!r} {n[5] + 0.5!r} {n[6]!r} 0 0 0"
    ),
    lambda n: " ".join(map(repr, n[2:])),
    lambda n: f"{n[2]!r} {n[6]!r} {n[4]!r}\n0 {n[3]!r} {n[5]!r}\n0 0 1\n",
    lambda n: f"{n[2]!r} 0 0\n{n[6]!r} {n[3]!r} 0\n{n[4] + 1!r} {n[5] + 1!r} 1\n",
)


def cameras(generator: np.random.Generator, folder: Path) -> None:
    """Read the file of another program; one with a coefficient that is not 0 must be refused."""
    width, height = (int(side) for side in generator.integers(64, 6000, 2))
    fx, fy = generator.uniform(0.2, 5, 2) * max(width, height)
    cx, cy = generator.uniform(0.1, 0.9, 2) * (width, height)
    k1 = float(generator.choice([0.0, -0.1, 3.0], p=[0.7, 0.2, 0.1]))
    write = WRITERS[int(generator.integers(len(WRITERS)))]
    path = folder / "camera"
    path.write_text(write((width, height, float(fx), float(fy), float(cx), float(cy), k1)))
    try:
        with warnings.catch_warnings(action="ignore"):
            found = Calibration.load(path, (width, height))
    except DeepDetectError as error:
        if not k1:
            raise Wrong(f"a good camera was refused: {error}") from error
        raise
    expect(k1 == 0, "distortion was dropped")
    truth = (fx, fy, cx, cy)
    got = (*found.camera0.focal_px, *found.camera0.centre)
    expect(np.allclose(got, truth, rtol=1e-9, atol=1e-6), f"{got} instead of {truth}")
    found.save(path)
    again = Calibration.load(path)
    expect((again.camera0, again.camera1) == (found.camera0, found.camera1), "not saved exactly")


TARGETS = (Target("cameras", "calibrations of other programs", cameras, 2000),)
