"""Calls of the public interface with arguments that are wrong, one or two of each call."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import deepdetect
from deepdetect import (
    Calibration,
    Camera,
    DeepDetect,
    Keypoints,
    Matches,
    PointDetector,
    SelectionOptions,
)
from deepdetect.geometry import GeometryOptions
from deepdetect.geometry.point_cloud import PointCloud

from ..case import Target, prepared

ODD: tuple[Any, ...] = (
    *(None, True, -1, 0, 1, 3, 10**30, 0.5, -2.5, float("nan"), float("inf"), 1j, "", "a", "auto"),
    *(b"a", [], [1], [[1, 2], [3]], (), (1, 2), (1, 2, 3), {}, {"a": 1}, {1}, object(), repr),
    *(Path("missing.png"), Path("/"), np.zeros(0), np.zeros((3, 2)), np.full((5, 2), np.nan)),
    *(np.zeros((20, 20)), np.zeros((20, 20, 3), "u1"), np.array("a"), np.array([None, 1])),
    *(np.float32(2), np.int64(7), np.bool_(True), slice(3), iter([1, 2]), SelectionOptions()),
    *(Camera((20, 20), 30.0), GeometryOptions()),
)


@prepared
def scenes() -> dict[str, Any]:
    """Return what calls are made with, where nothing is wrong."""
    generator = np.random.default_rng(3)
    scene = np.kron(generator.integers(0, 256, (24, 28)), np.ones((4, 4))).astype(np.uint8)
    points = PointDetector(60)
    found = points.extract(scene)
    return {"scene": scene, "points": points, "found": found, "network": DeepDetect()}


@prepared
def calls() -> dict[str, tuple[Callable[..., Any], dict[str, Any]]]:
    """Return functions with right arguments, by name; what is not given is as usual."""
    made = scenes()
    scene, points, found, network = (made[n] for n in ("scene", "points", "found", "network"))
    pair = {"image0": scene, "image1": np.roll(scene, 3, axis=1), "detector": points}
    xy = np.random.default_rng(0).uniform(0, 90, (30, 2))
    camera = Camera((112, 96), 100.0)
    calibration = Calibration(camera, camera)
    cloud = PointCloud(np.ones((4, 3), np.float32), np.ones((4, 3), np.uint8), "mm", "camera")
    matches = deepdetect.match_features(found, found)
    return {
        "load_image": (deepdetect.load_image, {"image": scene}),
        "DeepDetect": (DeepDetect, {}),
        "PointDetector": (PointDetector, {}),
        "detect": (network.detect, {"image": scene}),
        "heatmap": (network.heatmap, {"image": scene}),
        "detect_batch": (network.detect_batch, {"images": [scene]}),
        "extract": (network.extract, {"image": scene, "max_keypoints": 50}),
        "points.detect": (points.detect, {"image": scene}),
        "points.detect_batch": (points.detect_batch, {"images": [scene]}),
        "points.extract": (points.extract, {"image": scene}),
        "Keypoints": (Keypoints, {"xy": xy, "scores": np.ones(30), "image_size": (112, 96)}),
        "draw": (found.draw, {"image": scene}),
        "match_features": (deepdetect.match_features, {"features0": found, "features1": found}),
        "estimate_geometry": (deepdetect.estimate_geometry, {"matches": xy, "points1": xy + 3}),
        "SelectionOptions": (SelectionOptions, {}),
        "GeometryOptions": (GeometryOptions, {}),
        "Camera": (Camera, {"size": (112, 96), "focal_px": 100.0}),
        "Calibration": (Calibration, {"camera0": camera, "camera1": camera}),
        "Calibration.load": (Calibration.load, {"path": "missing.json"}),
        "load_keypoints": (deepdetect.load_keypoints, {"path": "missing.npz"}),
        "heatmap_and_logits": (network.heatmap_and_logits, {"image": scene}),
        "configured": (network.configured, {"heatmap_options": network.heatmap_options}),
        "with_weights": (network.with_weights, {"weights": "default"}),
        "save_point_cloud": (deepdetect.save_point_cloud, {"cloud": cloud, "path": "a.ply"}),
        "reconstruct_many": (deepdetect.reconstruct_many, {"images": "missing", "output": "out"}),
        "Matches": (Matches, {name: getattr(matches, name) for name in MATCHES}),
        "best": (found.best, {"count": 5}),
        "to_lightglue": (found.to_lightglue, {}),
        "Keypoints.empty": (Keypoints.empty, {"image_size": (112, 96)}),
        "from_opencv": (
            Keypoints.from_opencv,
            {"keypoints": found.to_opencv(), "image_size": (112, 96)},
        ),
        "Matches.with_geometry": (
            matches.with_geometry,
            {"found": deepdetect.estimate_geometry(matches)},
        ),
        "Matches.draw": (matches.draw, {"image0": scene, "image1": scene}),
        "project": (camera.project, {"points": np.ones((4, 3))}),
        "rays": (camera.rays, {"points": xy}),
        "scaled": (camera.scaled, {"size": (56, 48)}),
        "depth_mm": (calibration.depth_mm, {"disparity_px": np.ones(4)}),
        "check_sizes": (calibration.check_sizes, {"size0": (112, 96), "size1": (112, 96)}),
        "save_keypoints": (deepdetect.save_keypoints, {"keypoints": found, "path": "a.npz"}),
        "save_matches": (deepdetect.save_matches, {"matches": matches, "path": "a.npz"}),
        "load_matches": (deepdetect.load_matches, {"path": "missing.npz"}),
        "match_images": (deepdetect.match_images, pair),
        "register": (deepdetect.register, pair),
        "stitch": (deepdetect.stitch, {"images": [scene, scene], "detector": points}),
        "disparity_map": (deepdetect.disparity_map, {"image0": scene, "image1": scene}),
        "reconstruct": (deepdetect.reconstruct, pair | {"focal_px": 100.0}),
        "estimate_pose": (deepdetect.estimate_pose, pair | {"focal_px": 100.0}),
    }


MATCHES = ("points0", "points1", "scores", "inliers", "keypoints0", "keypoints1")
SLOW = ("match_images", "register", "stitch", "disparity_map", "reconstruct", "estimate_pose")


def called(generator: np.random.Generator, folder: Path) -> None:
    """Call a function with one or two arguments that may be wrong."""
    names = [*calls()]
    quick = [name for name in names if name not in SLOW]
    chosen = names if generator.random() < 0.1 else quick
    function, usual = calls()[chosen[int(generator.integers(len(chosen)))]]
    given = dict(usual)
    parameters = [*inspect.signature(function).parameters]
    if generator.random() < 0.5:  # where nothing is wrong with what is needed
        parameters = [name for name in parameters if name not in usual] or parameters
    for name in generator.choice(parameters, min(len(parameters), int(generator.integers(1, 3)))):
        given[str(name)] = ODD[int(generator.integers(len(ODD)))]
    with contextlib.chdir(folder):  # some write files
        found = function(**given)
    assert not isinstance(found, Matches) or len(found) >= 0


TARGETS = (Target("calls", "calls of public functions with wrong arguments", called, 5000, 250),)
