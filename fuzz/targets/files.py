"""Files that the library writes and reads: keypoints, matches, masks, settings, cameras."""

from __future__ import annotations

import io
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies

from deepdetect import Keypoints, load_keypoints, load_matches, save_keypoints
from deepdetect.geometry.camera import Calibration
from deepdetect.io.masks import encode_mask, load_mask
from deepdetect_lab.labels import find_label_settings
from deepdetect_lab.labels.detectors import DETECTORS

from ..case import Target, expect, prepared
from ..mutations import mutate
from .arrays import draw

JSON_VALUES = strategies.recursive(
    strategies.one_of(
        strategies.none(),
        strategies.booleans(),
        strategies.integers(),
        strategies.integers(10**300, 10**420),
        strategies.floats(),
        strategies.text(max_size=8),
    ),
    lambda inner: (
        strategies.lists(inner, max_size=3)
        | strategies.dictionaries(strategies.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=8,
)
CAMERA_KEYS = (
    *("focal_px", "cx", "cy", "width", "height", "baseline_mm", "disparity_offset_px"),
    *("left", "right"),
)
CALIBRATIONS = strategies.dictionaries(
    strategies.sampled_from(CAMERA_KEYS),
    JSON_VALUES | strategies.floats(1, 2000),
    max_size=6,
).map(lambda values: {"focal_px": 500.0, **values})

SETTINGS = {name: list(detector.defaults) for name, detector in DETECTORS.items()}
EXTREMES = (0, -1, 1, 2, 3, 10**6, 2**31, 2**63, 1e30, -1e30, 1e-30, 0.5, "nan", "inf", '"a"', "[]")


@prepared
def keypoints_file() -> bytes:
    """Return an npz file of keypoints."""
    generator = np.random.default_rng(1)
    found = Keypoints(generator.uniform(0, 50, (40, 2)), generator.uniform(0, 1, 40), (64, 64))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "keypoints.npz"
        save_keypoints(found, path)
        return path.read_bytes()


def keypoints(generator: np.random.Generator, folder: Path) -> None:
    """Load a damaged or altered file of keypoints, also as matches."""
    path = folder / "keypoints.npz"
    if generator.random() < 0.6:
        path.write_bytes(mutate(keypoints_file(), generator))
    else:
        path.write_bytes(altered_arrays(generator))
    if generator.random() < 0.2:
        load_matches(path)
        expect(False, "keypoints were read as matches")
    found = load_keypoints(path)
    expect(np.isfinite(found.xy).all() and found.xy.shape == (len(found), 2), "no positions")
    expect(np.isfinite(found.scores).all(), "scores are not finite")


def altered_arrays(generator: np.random.Generator) -> bytes:
    """Return an npz file some of whose arrays are of another type or shape."""
    values: dict[str, Any] = {
        "keypoints": np.ones((5, 2), np.float32),
        "scores": np.ones(5, np.float32),
        "image_size": np.array([20, 20]),
    }
    strange = [
        np.zeros(0),
        np.ones((5, 3)),
        np.array([np.nan] * 5),
        np.array("text"),
        np.ones(5, np.complex64),
        np.array(["a"] * 5),
        np.array([1]),
        np.array([-3, 10**18]),
        np.full((5, 2), 1e300),
        np.array(None, dtype=object),
        np.ones((2, 2, 2)),
        np.array([2, np.inf]),
    ]
    name = str(generator.choice([*values, "logits", "sizes", "angles"]))
    values[name] = strange[int(generator.integers(len(strange)))]
    if generator.random() < 0.2:
        del values[str(generator.choice(list(values)))]
    file = io.BytesIO()
    np.savez(file, **values)
    return file.getvalue()


def masks(generator: np.random.Generator, folder: Path) -> None:
    """Load a damaged mask."""
    content = encode_mask(generator.random((20, 24)) < 0.5)
    found = load_mask(mutate(content, generator))
    expect(found.dtype == bool and found.ndim == 2 and found.size > 0, "no mask")


def calibrations(generator: np.random.Generator, folder: Path) -> None:
    """Read a calibration of any values, damaged, or nested too deeply."""
    content = json.dumps(draw(CALIBRATIONS, generator)).encode()
    choice = generator.random()
    if choice < 0.3:
        content = mutate(content, generator)
    elif choice < 0.33:
        content = b'{"focal_px": ' + b"[" * 100_000 + b"]" * 100_000 + b"}"
    elif choice < 0.36:
        content = b"\xef\xbb\xbf" + content
    path = folder / "calib.json"
    path.write_bytes(content)
    found = Calibration.load(path, (64, 48), (64, 48))
    for camera in (found.camera0, found.camera1):
        expect(np.isfinite(camera.matrix).all(), "a camera that is not finite")
        expect(min(camera.matrix[0, 0], camera.matrix[1, 1]) > 0, "no focal length")


def label_settings(generator: np.random.Generator, folder: Path) -> None:
    """Read label settings with extreme values, or damaged ones."""
    detector = str(generator.choice(list(SETTINGS)))
    name = str(generator.choice(SETTINGS[detector]))
    value = EXTREMES[int(generator.integers(len(EXTREMES)))]
    part = str(generator.choice(["normal", "low_visibility"]))
    content = f"[{detector}]\n{part} = {{ {name} = {value} }}\n".encode()
    choice = generator.random()
    if choice < 0.3:
        content = mutate(content, generator)
    elif choice < 0.36:
        content = b"a = " + b"[" * 50_000 + b"]" * 50_000
    path = folder / "settings.toml"
    path.write_bytes(content)
    find_label_settings(path)


TARGETS = (
    Target("keypoints", "files of keypoints (npz)", keypoints, 1500),
    Target("masks", "masks", masks, 900),
    Target("calibrations", "calibrations", calibrations, 1200),
    Target("label-settings", "label settings", label_settings, 600, 100),
)
