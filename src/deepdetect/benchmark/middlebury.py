"""Middlebury stereo pairs: matches, those that fit the geometry, those that are right.

The reconstruction itself, with Figure 8, is another benchmark's.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ..datasets.middlebury import load_middlebury
from ..errors import ImageError
from ..geometry import GeometryOptions, estimate_geometry
from ..methods import Method
from ..metrics import stereo_score
from .options import BenchmarkOptions
from .paper_numbers import STEREO_POINTS
from .planar_paper import PAPER_MATCHING
from .report import Cell, Column, Section, Table
from .stages import find_matches
from .workspace import Workspace

CLASSICAL_ROWS = ("sift", "sift-low")
INLIER_THRESHOLD = 1.0


def middlebury_steps(workspace: Workspace, options: BenchmarkOptions) -> int:
    """Return the number of steps that `middlebury_sections` reports."""
    return len(_scenes(workspace)) * len(_methods(options))


def middlebury_sections(workspace: Workspace, options: BenchmarkOptions) -> list[Section]:
    """Match both views of each scene with all methods."""
    tables = tuple(_scene_table(workspace, options, scene) for scene in _scenes(workspace))
    text = (
        "Matches by FLANN, ratio 0.99, over the whole image; neither the rows nor the true "
        "disparity are used. Right: within 1 px of the true disparity, of those where it is "
        "known. Fit: left after the essential matrix (RANSAC, 1 px), which the paper calls voxels.",
        "Figure 8, the reconstructions, is not drawn here.",
    )
    return [Section("Middlebury stereo", text, tables)]


def _scenes(workspace: Workspace) -> list[Path]:
    folder = workspace.folder("middlebury")
    scenes = sorted(path.parent for path in folder.glob("*/left.png"))
    if not scenes:
        raise ImageError(
            f"there are no stereo scenes in {folder}: it must hold SCENE/left.png and right.png"
        )
    return scenes


def _methods(options: BenchmarkOptions) -> list[Method]:
    known = [m for m in options.density_methods() if m.name in CLASSICAL_ROWS]
    own = [options.native(), options.geometry()]
    return [*known, *options.others, *own, *options.native_controls()]


def _scene_table(workspace: Workspace, options: BenchmarkOptions, scene: Path) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for method in _methods(options):
        found = workspace.attempt(
            f"{method.title} on {scene.name}", _measure, workspace, method, scene
        )
        rows.append((method.title, *(found or (None,) * 5)))
        workspace.done(1, f"{method.name}, {scene.name}")
    if scene.name in STEREO_POINTS:
        paper = "DeepDetect's second weights, in the paper"
        rows.append((paper, None, None, STEREO_POINTS[scene.name], None, None))
    columns = (
        Column("method"),
        Column("keypoints a pixel", ".4f"),
        Column("matches", ",d"),
        Column("fit the geometry", ",d"),
        Column("right", ",d"),
        Column("share of the known", ".2%"),
    )
    try:
        load_middlebury(scene)
        note = ""
    except ImageError as error:
        note = f"Not judged: {error}"
        workspace.left_out.append(f"right matches on {scene.name}: {error}")
    return Table(f"middlebury_{scene.name}", scene.name, columns, tuple(rows), note)


def _measure(workspace: Workspace, method: Method, scene: Path) -> tuple[Cell, ...]:
    images = (scene / "left.png", scene / "right.png")
    found = find_matches(workspace.cache, method, images, PAPER_MATCHING)
    densities = [workspace.keypoints(method, image).features.density for image in images]
    camera = _camera(scene)

    def make() -> dict[str, np.ndarray]:
        options = GeometryOptions(
            model="essential",
            estimator="ransac",
            inlier_threshold=INLIER_THRESHOLD,
            camera0=camera,
            camera1=camera,
        )
        geometry = estimate_geometry(found.points0, found.points1, options)
        return {"inliers": np.array(int(geometry.inliers.sum()))}

    depends = {"camera": camera.tolist()}
    inliers = workspace.metric("essential inliers 1", method, images, depends, make)["inliers"]
    head: tuple[Cell, ...] = (float(np.mean(densities)), len(found), int(inliers))
    try:
        disparity = load_middlebury(scene).disparity
    except ImageError:
        return (*head, None, None)
    score = stereo_score(found.points0, found.points1, disparity)
    return (*head, score.right, score.share)


def _camera(scene: Path) -> np.ndarray:
    """Return the camera's matrix: the focal length of calib.json, the centre of the image."""
    try:
        values = json.loads((scene / "calib.json").read_text(encoding="utf-8"))
        focal, width, height = (float(values[name]) for name in ("focal_px", "width", "height"))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ImageError(
            f"{scene / 'calib.json'} does not tell focal_px, width and height ({error})"
        ) from None
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
