"""Cameras and points of many photographs whose cameras are known: ranked points, SIFT, chance."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from ...datasets.pair_selection import evenly_spaced
from ...datasets.posed_images import PosedImage, PosedScene
from ...geometry.camera import Camera
from ...geometry.posed_view import PosedView
from ...io.image import load_image
from ...sfm.colmap import import_pycolmap
from ..cache import Arrays, file_digest, matrix_digest
from ..charts import line_chart
from ..context import BenchmarkContext
from ..metrics.multi_view import (
    AGREEMENT_PX,
    MAX_GAP_PX,
    PLANE_NEIGHBOURS,
    CameraErrors,
    camera_errors,
    relative_pose_errors,
)
from ..metrics.pose import pose_auc
from ..options import BenchmarkOptions
from ..profiling import run_in_child
from ..report import Cell, Column, Figure, Table
from ..tasks import Part, SectionPlan, Shown, Task
from .sfm_methods import (
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
from .sfm_results import SfmModel, SfmResult, pack_result, unpack_result

MIN_PHOTOGRAPHS = 3

POSE_THRESHOLDS_DEG = (0.5, 1.0, 5.0)
"""Of the AUC: adjusted cameras are more accurate than those of two photographs."""

CURVE_DEG = tuple(0.05 * step for step in range(61))
"""Errors at which the figure is drawn."""

POINTS = "DeepDetect, points"
SIFT = "SIFT, pycolmap"
RANDOM = "baseline: as many random points"

GIVEN, ESTIMATED = "true", "estimated"

TEXT = (
    "The cameras of all photographs of a scene and sparse points are reconstructed from nothing "
    "but the photographs, as by `reconstruct_many`: every pair is matched, COLMAP verifies and "
    "maps, and a last adjustment with a robust loss follows. All methods go through the same "
    "stages with the same options, once with the true intrinsics and once with estimated ones; "
    "the true poses only judge. What differs are the keypoints: the ranked points of DeepDetect; "
    "as many random points with their sizes, described and matched as they are; and pycolmap's "
    "own SIFT with its own matcher, at as many places at most, some of them at two angles.",
    "Dense points are matched along rows of rectified photographs, whatever the keypoints were: "
    "they depend on these by the poses only. Where there is no scan to compare them with, those of "
    "every second photograph are compared with those of the others, with the poses of all.",
)


@dataclass(frozen=True, eq=False)
class SfmScene:
    """The photographs of a scene that are reconstructed.

    Attributes:
        name: of the scene.
        images: with their cameras.
    """

    name: str
    images: tuple[PosedImage, ...]

    @property
    def cameras(self) -> dict[str, Camera]:
        """The true cameras by the names of the files."""
        return {image.path.name: _camera(image) for image in self.images}

    @property
    def truth(self) -> dict[str, PosedView]:
        """The true cameras and poses by the names of the files."""
        return {
            name: PosedView(name, camera, image.rotation, image.translation)
            for image in self.images
            for name, camera in ((image.path.name, _camera(image)),)
        }


def _camera(image: PosedImage) -> Camera:
    height, width = load_image(image.path).shape[:2]
    matrix = image.intrinsics
    return Camera((width, height), (matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2]))


def choose_photographs(scene: PosedScene, most: int) -> SfmScene:
    """Return the photographs of a scene: all, the first of a sequence, or evenly spaced ones.

    A sequence is one whose pairs have frame distances: between evenly spaced frames of a long one
    there would be nothing in common.
    """
    sequence = scene.pairs[0].frame_distance is not None
    images = scene.images[:most] if sequence else evenly_spaced(scene.images, most)
    return SfmScene(scene.name, tuple(images))


def sfm_methods(options: BenchmarkOptions) -> list[SfmMethod]:
    """Return the ranked points, SIFT where it is among the baselines, and random points."""
    digest = str(SFM_POINTS.settings)
    methods = [SfmMethod(POINTS, find_points, depends=digest)]
    if "sift" in options.classical:
        methods.append(SfmMethod(SIFT, find_sift, match_sift))
    return [*methods, SfmMethod(RANDOM, find_random_points, depends=digest, chance=True)]


Results = Mapping[tuple[str, str], SfmResult]
"""By scene and title of the method."""


def sfm_section(
    context: BenchmarkContext, options: BenchmarkOptions, scenes: Sequence[PosedScene]
) -> SectionPlan:
    """Reconstruct all scenes by all methods."""
    import_pycolmap()  # what is missing is said at once
    chosen = []
    for scene in scenes:
        if len(scene.images) < MIN_PHOTOGRAPHS:
            context.fail(f"{scene.name}: it has {len(scene.images)} photographs, 3 are needed")
        else:
            chosen.append(choose_photographs(scene, options.sfm.max_photographs))
    for feature in options.others:
        context.skipped.append(f"sfm: {feature.title}: this benchmark runs no further methods")
    methods = sfm_methods(options)
    tasks = {
        (scene.name, method.title): Task(
            f"{scene.name} by {method.title}", partial(measure_scene, context, method, scene)
        )
        for scene in chosen
        for method in methods
    }
    titles = [method.title for method in methods]

    def summarize(found: Results) -> Shown:
        return [
            camera_table(chosen, titles, found),
            cost_table(chosen, titles, found),
            dense_table(chosen, titles, found),
            photograph_table(chosen, titles, found),
            *(error_figure(scene, titles, found) for scene in chosen),
        ]

    return SectionPlan("Many photographs", TEXT, [Part(tasks, summarize)])


def measure_scene(context: BenchmarkContext, method: SfmMethod, scene: SfmScene) -> SfmResult:
    """Reconstruct a scene by a method, or read the result from the cache."""
    task = SfmTask(method, tuple(image.path for image in scene.images), scene.cameras)

    def make() -> Arrays:
        return pack_result(run_in_child(run_method, task))

    key = {
        "method": [method.title, method.depends],
        "images": [file_digest(image.path) for image in scene.images],
        "names": [image.path.name for image in scene.images],
        "intrinsics": [matrix_digest(image.intrinsics) for image in scene.images],
        "options": repr(vars(OPTIONS)),
        "agreement": [PLANE_NEIGHBOURS, MAX_GAP_PX, AGREEMENT_PX],
        "pycolmap": import_pycolmap().__version__,
    }
    return unpack_result(context.cache.get("sfm", key, make))


def _models(result: SfmResult) -> list[tuple[str, SfmModel]]:
    return [(GIVEN, result.given), (ESTIMATED, result.estimated)]


def _errors(model: SfmModel, scene: SfmScene) -> CameraErrors | None:
    """Return the errors of the registered cameras; None of fewer than three."""
    if len(model.views) < MIN_PHOTOGRAPHS:
        return None
    truth = scene.truth
    return camera_errors(list(model.views.values()), [truth[name] for name in model.views])


def _apart(model: SfmModel, other: SfmModel | None, truth: Mapping[str, PosedView]) -> float | None:
    """Return the mean distance of the centres of two models in the unit of the truth."""
    names = sorted(set(model.views) & set(() if other is None else other.views))
    if other is None or len(names) < MIN_PHOTOGRAPHS:
        return None
    views, others = ([each.views[name] for name in names] for each in (model, other))
    unit = camera_errors(others, [truth[name] for name in names]).scale
    return unit * float(camera_errors(views, others).centres.mean())


def path_extent(scene: SfmScene) -> float:
    """Return the largest distance of two true cameras."""
    centres = np.array([view.centre for view in scene.truth.values()])
    return float(np.linalg.norm(centres[:, None] - centres, axis=2).max())


def camera_table(scenes: Sequence[SfmScene], titles: Sequence[str], found: Results) -> Table:
    """Tabulate cameras and sparse points of each method on each scene."""
    columns = (
        *(Column("scene"), Column("keypoints"), Column("intrinsics")),
        *(Column("photographs", "d"), Column("registered", "d")),
        *(Column(f"AUC at {threshold:g}°", ".3f") for threshold in POSE_THRESHOLDS_DEG),
        *(Column("centres, unit of the truth", ".5f"), Column("centres, ‰ of the extent", ".2f")),
        *(Column("from the first row's, unit of the truth", ".5f"), Column("rotations, °", ".3f")),
        Column("sparse points", ",d"),
        *(Column("track length", ".2f"), Column("reprojection error, px", ".3f")),
    )
    rows: list[tuple[Cell, ...]] = []
    for scene in scenes:
        truth, extent = scene.truth, path_extent(scene)
        for title in titles:
            if (scene.name, title) not in found:
                continue
            for kind, model in _models(found[scene.name, title]):
                first = found.get((scene.name, titles[0])) if title != titles[0] else None
                other = None if first is None else dict(_models(first))[kind]
                pairs = relative_pose_errors(model.views, truth)
                errors = _errors(model, scene)
                centre = None if errors is None else float(errors.centres.mean())
                rows.append(
                    (
                        *(scene.name, title, kind, len(scene.images), len(model.views)),
                        *(pose_auc(pairs, threshold) for threshold in POSE_THRESHOLDS_DEG),
                        centre,
                        None if centre is None else 1000 * centre / extent,
                        _apart(model, other, truth),
                        None if errors is None else float(errors.rotations_deg.mean()),
                        *(model.points, model.track_length, model.error_px),
                    )
                )
    note = (
        "AUC: of the relative poses of all pairs of photographs, the error of a pair being the "
        "larger of the angle of the rotation and the angle between the directions of translation; "
        "pairs with a photograph that is not registered count as infinite. Centres and rotations: "
        "mean errors of the registered cameras after the alignment of their centres (rotation, "
        "shift and scale); extent: the largest distance of two true cameras. From the first row's: "
        "mean distance of the centres from those of the first method; where that is much less than "
        "the errors of both, these are the truth's, or common to both. Of cameras on a "
        "straight line the alignment leaves a rotation open: take the AUC. Track length: mean "
        "number of photographs that see a point. Reprojection error: mean; the points are the "
        "method's own, so it is no error of the cameras."
    )
    return Table("sfm", "Cameras and sparse points", columns, tuple(rows), note)


def cost_table(scenes: Sequence[SfmScene], titles: Sequence[str], found: Results) -> Table:
    """Tabulate what each method takes."""
    columns = (
        *(Column("scene"), Column("keypoints"), Column("keypoints a photograph", ",.0f")),
        Column("matches", ",d"),
        *(Column(f"keypoints and matches, {unit}", ".1f") for unit in ("s", "CPU s")),
        *(Column(f"mapping, {kind} intrinsics, CPU s", ".1f") for kind in (GIVEN, ESTIMATED)),
        *(Column("memory, MB", ",.0f"), Column("dense points, CPU s", ".1f")),
        Column("memory with dense points, MB", ",.0f"),
    )
    rows: list[tuple[Cell, ...]] = []
    for scene in scenes:
        for title in titles:
            if (scene.name, title) not in found:
                continue
            one = found[scene.name, title]
            dense = one.dense_memory > 0
            rows.append(
                (
                    *(scene.name, title, one.keypoints, one.matches, one.seconds),
                    *(one.cpu_seconds, one.given.cpu_seconds, one.estimated.cpu_seconds),
                    one.memory / 1e6,
                    one.dense_cpu_seconds if dense else None,
                    one.dense_memory / 1e6 if dense else None,
                )
            )
    note = (
        "Of one process, which has no other work: keypoints, descriptors and matches on one "
        "thread, verification and mapping on as many as COLMAP takes. Memory: the most that the "
        "process held, with Python and all libraries. Random points take the places of ranked "
        "ones, which are found first: that is in their memory, not in their seconds. "
        "Seconds may be those of an earlier run, from the cache; on a busy machine compare CPU "
        "seconds."
    )
    return Table("sfm_cost", "Seconds and memory", columns, tuple(rows), note)


def dense_table(scenes: Sequence[SfmScene], titles: Sequence[str], found: Results) -> Table:
    """Tabulate how far the dense points of two halves of the photographs agree."""
    columns = (
        *(Column("scene"), Column("poses by"), Column("dense points", ",d")),
        *(Column("covered", ".1%"), Column("median distance, px", ".3f")),
        Column("median distance, ‰ of the depth", ".3f"),
        *(Column(f"within {limit:g} px", ".1%") for limit in AGREEMENT_PX),
    )
    rows: list[tuple[Cell, ...]] = []
    for scene in scenes:
        for title in titles:
            if (scene.name, title) not in found:
                continue
            one = found[scene.name, title]
            if not one.agreement:
                rows.append(
                    (scene.name, title, sum(one.dense_points), *[None] * (len(columns) - 3))
                )
                continue
            mean = partial(np.average, weights=[each.points for each in one.agreement])
            rows.append(
                (
                    *(scene.name, title, sum(one.dense_points)),
                    float(mean([each.covered for each in one.agreement])),
                    float(mean([each.median_px for each in one.agreement])),
                    1000 * float(mean([each.median_depth_ratio for each in one.agreement])),
                    *(
                        float(mean([each.within[k] for each in one.agreement]))
                        for k in range(len(AGREEMENT_PX))
                    ),
                )
            )
    note = (
        "True intrinsics. Every second photograph is matched with others of its half only, and so "
        "are those between: the two sets of points have no photograph in common, but the poses. "
        "Dense points: of both together. Covered: fraction of the points that have one of the "
        f"other set within {MAX_GAP_PX:g} px in the nearest photograph. Distance: from a covered "
        f"point along its line of sight to the plane of the {PLANE_NEIGHBOURS} nearest points of "
        "the other set, in px of the photograph that shows it largest, and over the depth; within: "
        "fraction of the covered points. It shows how the matches scatter, not what both halves "
        "have in common: errors of the poses, or edges that are too wide in both. Few points that "
        "are covered may agree well: read both."
    )
    return Table("sfm_dense", "Dense points of two halves", columns, tuple(rows), note)


def photograph_table(scenes: Sequence[SfmScene], titles: Sequence[str], found: Results) -> Table:
    """Tabulate the errors of each camera."""
    columns = (
        *(Column("scene"), Column("keypoints"), Column("intrinsics"), Column("photograph")),
        *(Column("centre, unit of the truth", ".5f"), Column("rotation, °", ".4f")),
    )
    rows: list[tuple[Cell, ...]] = []
    for scene in scenes:
        for title in titles:
            if (scene.name, title) not in found:
                continue
            for kind, model in _models(found[scene.name, title]):
                errors = _errors(model, scene)
                places = {name: k for k, name in enumerate(model.views)}
                for image in scene.images:
                    name = image.path.name
                    cells: tuple[Cell, ...] = (None, None)
                    if errors is not None and name in places:
                        k = places[name]
                        cells = float(errors.centres[k]), float(errors.rotations_deg[k])
                    rows.append((scene.name, title, kind, name, *cells))
    note = "After the alignment of the centres; a dash: the photograph is not registered."
    return Table("sfm_photographs", "All photographs", columns, tuple(rows), note, in_text=False)


def error_figure(scene: SfmScene, titles: Sequence[str], found: Results) -> Figure:
    """Draw the fraction of the pairs of photographs under each error of their relative pose."""
    lines = {}
    for title in titles:
        if (scene.name, title) not in found:
            continue
        for kind, model in _models(found[scene.name, title]):
            errors = np.array(relative_pose_errors(model.views, scene.truth))
            shares = [float((errors <= limit).mean()) for limit in CURVE_DEG]
            lines[f"{title}, {kind} intrinsics"] = CURVE_DEG, shares
    png = line_chart(lines, "error of the relative pose up to, °", "fraction of the pairs")
    title = f"Relative poses of all pairs of {scene.name}: fraction up to each error"
    name = re.sub(r"\W+", "_", scene.name)
    return Figure(f"sfm_{name}", title, png)
