"""Cameras and points of many images whose cameras are known: ranked points, SIFT, chance."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..._shared.records import Arrays
from ...datasets.pair_selection import evenly_spaced
from ...datasets.posed_images import PosedImage, PosedScene, load_posed_scenes
from ...geometry.camera import Camera, PosedView
from ...io.image import load_image
from ...sfm.colmap import import_pycolmap
from ..charts import line_chart
from ..metrics.multi_view import camera_errors, relative_pose_errors
from ..metrics.pose import pose_auc
from ..options import BenchmarkOptions
from ..profiling import run_in_child
from ..report import Cell, Column, Figure, Row, Section, Table, where
from ..run import Run
from .sfm_methods import (
    KINDS,
    OPTIONS,
    SFM_POINTS,
    SfmMethod,
    SfmTask,
    find_points,
    find_random_points,
    find_sift,
    match_sift,
    run_method,
)

MIN_IMAGES = 3

POSE_THRESHOLDS_DEG = (0.5, 1.0, 5.0)
"""Of the AUC: adjusted cameras are more accurate than those of two images."""

CURVE_DEG = tuple(0.05 * step for step in range(61))
"""Errors at which the figure is drawn."""

TEXT = (
    "The cameras of all images of a scene and sparse points are reconstructed from nothing but the "
    "images, as by `reconstruct_many`: every pair is matched, COLMAP verifies and maps, and a last "
    "adjustment with a robust loss follows. All methods go through the same stages with the same "
    "options, once with the true intrinsics and once with estimated ones; the true poses only "
    "judge. What differs are the keypoints: the ranked points of DeepDetect; as many random points "
    "with their sizes, described and matched as they are; and pycolmap's own SIFT with its own "
    "matcher, at as many places at most, some of them at two angles.",
)

CAMERA_NOTE = (
    "AUC: of the relative poses of all pairs of images, the error of a pair being the larger of "
    "the angle of the rotation and the angle between the directions of translation; pairs with an "
    "image that is not registered count as infinite. Centres and rotations: mean errors of the "
    "registered cameras after the alignment of their centres (rotation, shift and scale); extent: "
    "the largest distance of two true cameras. From the first row's: mean distance of the centres "
    "from those of the first method; where that is much less than the errors of both, these are "
    "the truth's, or common to both. Of cameras on a straight line the alignment leaves a rotation "
    "open: take the AUC. Track length: mean number of images that see a point. Reprojection error: "
    "mean; the points are the method's own, so it is no error of the cameras."
)

COST_NOTE = (
    "Of one process, which has no other work: keypoints, descriptors and matches on one thread, "
    "verification and mapping on as many as COLMAP takes. Memory: the most that the process held, "
    "with Python and all libraries. Random points take the places of ranked ones, which are found "
    "first: that is in their memory, not in their seconds. On a busy machine compare CPU seconds."
)


@dataclass(frozen=True, eq=False)
class SfmScene:
    """The images of a scene that are reconstructed, with their cameras."""

    name: str
    images: tuple[PosedImage, ...]

    @property
    def cameras(self) -> dict[str, Camera]:
        """The true cameras by the names of the files."""
        return {name: view.camera for name, view in self.truth.items()}

    @property
    def truth(self) -> dict[str, PosedView]:
        """The true cameras and poses by the names of the files."""
        views = {}
        for image in self.images:
            name, matrix = image.path.name, image.intrinsics
            height, width = load_image(image.path).shape[:2]
            focal, centre = (matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2])
            camera = Camera((width, height), focal, centre)
            views[name] = PosedView(name, camera, image.rotation, image.translation)
        return views


@dataclass(frozen=True, eq=False)
class SfmModel:
    """A model with one kind of intrinsics.

    Attributes:
        views: the registered cameras by name.
        points: number of sparse points.
        track_length: mean number of images that see one.
        error_px: mean reprojection error.
        cpu_seconds: of verification and mapping.
    """

    views: Mapping[str, PosedView]
    points: int
    track_length: float
    error_px: float
    cpu_seconds: float


def sfm(run: Run, options: BenchmarkOptions) -> list[Section]:
    """Reconstruct all scenes by all methods."""
    import_pycolmap()  # what is missing is said at once
    folder = run.folder("sfm")
    scenes = load_posed_scenes(run.folder("pose") if folder == run.data else folder)
    chosen = {}
    for scene in scenes:
        if len(scene.images) < MIN_IMAGES:
            run.fail(f"{scene.name}: it has {len(scene.images)} images, 3 are needed")
        else:
            chosen[scene.name] = choose_images(scene, options.max_images)
    for feature in options.others:
        run.skipped.append(f"sfm: {feature.title}: this benchmark runs no further methods")
    methods = sfm_methods(options)
    rows = run.rows("", methods, chosen, lambda method, scene: measure_scene(run, method, scene))
    groups = [
        (scene, method, row)
        for name, scene in chosen.items()
        for method in methods
        for row in where(rows, item=name, method=method.name)
    ]
    tables = [camera_table(groups), cost_table(groups)]
    figures = [error_figure(scene, groups) for scene in chosen.values()]
    return [Section("Many images", TEXT, tables, figures)]


def choose_images(scene: PosedScene, most: int) -> SfmScene:
    """Return the images of a scene: all, the first of a sequence, or evenly spaced ones.

    A sequence is one whose pairs have frame distances: between evenly spaced frames of a long one
    there would be nothing in common.
    """
    sequence = scene.pairs[0].frame_distance is not None
    images = scene.images[:most] if sequence else evenly_spaced(scene.images, most)
    return SfmScene(scene.name, tuple(images))


def sfm_methods(options: BenchmarkOptions) -> list[SfmMethod]:
    """Return the ranked points, SIFT where it is among the baselines, and random points."""
    digest = str(SFM_POINTS.settings)
    methods = [SfmMethod("DeepDetect, points", find_points, depends=digest)]
    if "sift" in options.classical:
        methods.append(SfmMethod("SIFT, pycolmap", find_sift, match_sift))
    title = "baseline: as many random points"
    return [*methods, SfmMethod(title, find_random_points, depends=digest, chance=True)]


def measure_scene(run: Run, method: SfmMethod, scene: SfmScene) -> Row:
    """Reconstruct a scene by a method, or read the result from the cache.

    Returns:
        The values of `run_method`, but a `SfmModel` each for "true" and "estimated" intrinsics.
    """
    images = tuple(image.path for image in scene.images)
    truth = scene.truth
    task = SfmTask(method, images, scene.cameras)
    depends = (
        (method.title, method.depends),
        [(image.path, image.path.name, image.intrinsics) for image in scene.images],
        repr(vars(OPTIONS)),
        import_pycolmap().__version__,
    )
    kept: Arrays = run.cached("sfm", depends, lambda: run_in_child(run_method, task))
    row: Row = {name: value.tolist() for name, value in kept.items()}
    for kind in KINDS:
        views = {
            name: PosedView(name, truth[name].camera, pose[:9].reshape(3, 3), pose[9:])
            for name, pose in zip(
                kept[f"{kind} names"].tolist(), kept[f"{kind} poses"], strict=True
            )
        }
        points, track_length, error_px, cpu_seconds = row[f"{kind} numbers"]
        row[kind] = SfmModel(views, int(points), track_length, error_px, cpu_seconds)
    return row


Groups = Sequence[tuple[SfmScene, SfmMethod, Row]]
"""Scenes and methods with what was measured, in the order of the tables' lines."""


def _apart(model: SfmModel, other: SfmModel, truth: Mapping[str, PosedView]) -> float | None:
    """Return the mean distance of the centres of two models in the unit of the truth."""
    names = sorted(set(model.views) & set(other.views))
    if len(names) < MIN_IMAGES:
        return None
    views, others = ([each.views[name] for name in names] for each in (model, other))
    unit = camera_errors(others, [truth[name] for name in names]).scale
    return unit * float(camera_errors(views, others).centres.mean())


def path_extent(truth: Mapping[str, PosedView]) -> float:
    """Return the largest distance of two true cameras."""
    centres = np.array([view.centre for view in truth.values()])
    return float(np.linalg.norm(centres[:, None] - centres, axis=2).max())


def camera_table(groups: Groups) -> Table:
    """Tabulate cameras and sparse points of each method on each scene."""
    columns = (
        *(Column("scene"), Column("keypoints"), Column("intrinsics")),
        *(Column("images", "d"), Column("registered", "d")),
        *(Column(f"AUC at {threshold:g}°", ".3f") for threshold in POSE_THRESHOLDS_DEG),
        *(Column("centres, unit of the truth", ".5f"), Column("centres, ‰ of the extent", ".2f")),
        *(Column("from the first row's, unit of the truth", ".5f"), Column("rotations, °", ".3f")),
        Column("sparse points", ",d"),
        *(Column("track length", ".2f"), Column("reprojection error, px", ".3f")),
    )
    rows: list[tuple[Cell, ...]] = []
    for scene, method, row in groups:
        truth = scene.truth
        first = next((r for s, m, r in groups if s is scene and m.name == groups[0][1].name), None)
        for kind in KINDS:
            model: SfmModel = row[kind]
            pairs = relative_pose_errors(model.views, truth)
            centre = rotation = None
            if len(model.views) >= MIN_IMAGES:
                views, true = list(model.views.values()), [truth[name] for name in model.views]
                errors = camera_errors(views, true)
                centre, rotation = (
                    float(values.mean()) for values in (errors.centres, errors.rotations_deg)
                )
            rows.append(
                (
                    *(scene.name, method.title, kind, len(scene.images), len(model.views)),
                    *(pose_auc(pairs, threshold) for threshold in POSE_THRESHOLDS_DEG),
                    centre,
                    None if centre is None else 1000 * centre / path_extent(truth),
                    None if first is None or first is row else _apart(model, first[kind], truth),
                    rotation,
                    *(model.points, model.track_length, model.error_px),
                )
            )
    return Table("sfm", "Cameras and sparse points", columns, tuple(rows), CAMERA_NOTE)


def cost_table(groups: Groups) -> Table:
    """Tabulate what each method takes."""
    columns = (
        *(Column("scene"), Column("keypoints"), Column("keypoints an image", ",.0f")),
        Column("matches", ",d"),
        *(Column(f"keypoints and matches, {unit}", ".1f") for unit in ("s", "CPU s")),
        *(Column(f"mapping, {kind} intrinsics, CPU s", ".1f") for kind in KINDS),
        Column("memory, MB", ",.0f"),
    )
    rows = tuple(
        (
            *(scene.name, method.title, row["keypoints"], row["matches"], row["seconds"]),
            row["cpu seconds"],
            *(row[kind].cpu_seconds for kind in KINDS),
            row["memory"] / 1e6,
        )
        for scene, method, row in groups
    )
    return Table("sfm_cost", "Seconds and memory", columns, rows, COST_NOTE)


def error_figure(scene: SfmScene, groups: Groups) -> Figure:
    """Draw the fraction of the pairs of images under each error of their relative pose."""
    lines = {}
    for one, method, row in groups:
        for kind in KINDS if one is scene else ():
            errors = np.array(relative_pose_errors(row[kind].views, scene.truth))
            shares = [float((errors <= limit).mean()) for limit in CURVE_DEG]
            lines[f"{method.title}, {kind} intrinsics"] = CURVE_DEG, shares
    png = line_chart(lines, "error of the relative pose up to, °", "fraction of the pairs")
    title = f"Relative poses of all pairs of {scene.name}: fraction up to each error"
    name = re.sub(r"\W+", "_", scene.name)
    return Figure(f"sfm_{name}", title, png)
