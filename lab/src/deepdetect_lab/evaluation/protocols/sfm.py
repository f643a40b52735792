"""Evaluate structure from motion on scenes with known cameras, with different keypoints.

All methods run the stages of `reconstruct_many` with the same options. Each runs in its own
process, so that its memory can be measured.
"""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from deepdetect._shared.errors import NoDepthError
from deepdetect.batch.extraction import feature_group
from deepdetect.batch.hdf5 import Group, import_h5py, open_hdf5, write_groups
from deepdetect.detector.point_detector import PointDetector
from deepdetect.features.keypoints import Keypoints
from deepdetect.features.scale_space import dominant_angles
from deepdetect.geometry.camera import Camera, PosedView
from deepdetect.io.image import load_image, luma
from deepdetect.sfm.colmap import PIXEL_CENTRE, import_pycolmap, initial_intrinsics, quiet_pycolmap
from deepdetect.sfm.mapping import read_sparse_model
from deepdetect.sfm.pipeline import MAX_KEYPOINTS
from deepdetect.sfm.stages import MultiViewOptions, Stages

from ...datasets.pair_selection import evenly_spaced
from ...datasets.posed_images import PosedScene, load_posed_scenes
from ..metrics.homography import area_under_curve
from ..metrics.pose import camera_errors, relative_pose_errors
from ..options import BenchmarkOptions
from ..profiling import peak_memory, run_in_child
from ..report import Row, Rows, Section, Table, where
from ..run import Run
from .dense_points import DENSE_COLUMNS, DENSE_NOTE, SGBM, measure_dense_points

MIN_IMAGES = 3

POSE_THRESHOLDS_DEG = (0.5, 1.0, 5.0)
"""Thresholds of the pose AUC. They are lower than those for image pairs, because poses are more
accurate after bundle adjustment."""

DATABASE = "sift.db"

OPTIONS = MultiViewOptions(pairs="exhaustive")
"""Options of all methods: defaults of `reconstruct_many`, but all image pairs are matched."""

KINDS = ("true", "estimated")
MODEL_COLUMNS = {"sparse points": ",d", "track length": ".2f", "reprojection error, px": ".3f"}

CAMERA_COLUMNS = {
    **{"scene": "", "keypoints": "", "intrinsics": "", "images": "d", "registered": "d"},
    **{f"AUC at {threshold:g}°": ".3f" for threshold in POSE_THRESHOLDS_DEG},
    "centres, unit of the truth": ".5f",
    "from the first row's, unit of the truth": ".5f",
    "rotations, °": ".3f",
    **MODEL_COLUMNS,
}

MAPPING_CPU = "mapping, {} intrinsics, CPU s"

COST_COLUMNS = {
    "scene": "",
    "keypoints": "",
    "keypoints an image": ",.0f",
    "matches": ",d",
    "keypoints and matches, s": ".1f",
    "keypoints and matches, CPU s": ".1f",
    **{MAPPING_CPU.format(kind): ".1f" for kind in KINDS},
    "memory, MB": ",.0f",
}

TEXT = (
    "The stages of `reconstruct_many` reconstruct cameras and sparse points: every image pair is "
    "matched, COLMAP verifies the matches and estimates cameras and points, tracks are refined, "
    "and a last bundle adjustment has a robust loss. All methods have the same options. They run "
    "once with true and once with estimated intrinsics; true poses are only used for evaluation. "
    "Methods differ in the keypoints: the ranked points of DeepDetect; as many random points with "
    "the same sizes; and SIFT of pycolmap, with its own matcher, where `max_num_features` is the "
    "number of ranked points that are asked for. This does not limit SIFT: COLMAP takes whole "
    "scales, the coarsest first, until there are enough, and some positions get several "
    "orientations. It gave up to 1.8 times as many keypoints, at up to 1.5 times as many "
    "positions, and the finest scales were missing; the second table has the numbers. SIFT runs "
    'once with and once without refinement of its tracks. "Dense tracks" uses the ranked points '
    "with the option `--matches dense`. If only the GPS positions of a scene are known, the camera "
    "centres are compared with them.",
)

CAMERA_NOTE = (
    "AUC: area under the cumulative error curve of the relative poses of all image pairs, up to "
    "this threshold. The error of a pair is the larger of two angles, the rotation and the "
    "translation error, or infinite if an image is not registered. Centres and rotations: mean "
    "errors of the registered cameras after their centres are aligned with the true ones. From the "
    "first row's: mean distance between the camera centres of this method and of the first method. "
    "If this distance is much smaller than the errors of both methods, the ground truth is "
    "inaccurate, or both methods make the same error. If all cameras are on a straight line, the "
    "alignment leaves the rotation about the line undetermined, so no rotation error is given; use "
    "the AUC. Track length: mean number of images that see a point. Reprojection error: mean over "
    "the method's own points; it does not show how accurate the cameras are."
)

COST_NOTE = (
    "Each method runs in its own process. Keypoints, descriptors and matches are computed on one "
    "thread, verification and mapping on COLMAP's default number of threads. Memory: peak memory "
    "of the process, including Python and all libraries. The method with random points first "
    "computes the ranked points that it replaces. Their memory is included, their time is not. If "
    "the machine was busy, compare CPU seconds."
)


Pair = tuple[str, str]


@dataclass(frozen=True)
class SfmMethod:
    """A method that the benchmark compares. `name` is its title in the tables.

    `find` writes the keypoints of a folder of images to a file, and `match` returns the matches of
    image pairs. Both functions must be module-level, because another process runs them. `name` and
    `version` identify cached results. If `chance` is set, the time of `find` is not reported. If
    `refined` is set, COLMAP's tracks are refined. `tracks` is `MultiViewOptions.matches`.
    """

    name: str
    find: Callable[[Stages, Path], None]
    match: Callable[[Stages, Sequence[Pair]], dict[Pair, np.ndarray]] = Stages.match
    version: str = ""
    chance: bool = False
    refined: bool = True
    tracks: Literal["sparse", "dense"] = "sparse"


def sfm(run: Run, options: BenchmarkOptions) -> list[Section]:
    """Run the benchmark: reconstruct each scene by each method, and measure dense points."""
    import_pycolmap()  # fails early if pycolmap is not installed
    folder = run.folder("sfm")
    scenes = load_posed_scenes(run.folder("pose") if folder == run.data else folder, located=True)
    chosen = {}
    for each in scenes:
        if len(each.images) < MIN_IMAGES:
            run.fail(f"{each.name}: it has {len(each.images)} images, but at least 3 are needed")
        else:
            chosen[each.name] = choose_images(each, options.max_images)
    for feature in options.others:
        run.skipped.append(f"sfm: {feature.title}: the benchmark sfm only runs its own methods")
    methods = sfm_methods(options)
    rows = run.rows("", methods, chosen, partial(measure_scene, run))
    rows = [row for name in chosen for row in where(rows, item=name)]
    costs = [{**row, "scene": row["scene"].name, "keypoints": row["method"]} for row in rows]
    cost_table = Table("sfm_cost", "Seconds and memory", COST_COLUMNS, costs, COST_NOTE)
    points = PointDetector(MAX_KEYPOINTS, ranker=options.ranker)
    dense = [
        run.attempt(f"dense points of {name}", dense_rows, run, chosen[name], points)
        for name in chosen
    ]
    found = [row for rows in dense for row in rows or ()]
    dense_table = Table("sfm_dense", "Dense points", DENSE_COLUMNS, found, DENSE_NOTE)
    tables = [camera_table(rows), cost_table, dense_table]
    return [Section("Many images", TEXT, tables)]


def choose_images(scene: PosedScene, most: int) -> PosedScene:
    """Keep at most `most` images of a scene: the first of a sequence, otherwise evenly spaced ones.

    Evenly spaced frames of a long sequence would not overlap.
    """
    sequence = bool(scene.pairs) and scene.pairs[0].frame_distance is not None
    images = scene.images[:most] if sequence else evenly_spaced(scene.images, most)
    return replace(scene, images=tuple(images))


def sfm_methods(options: BenchmarkOptions) -> list[SfmMethod]:
    """Return two methods with ranked points, two with SIFT if chosen, and a chance baseline."""
    points = PointDetector(MAX_KEYPOINTS, ranker=options.ranker)
    version, random = _version(points), "baseline: as many random points"
    ours = SfmMethod("DeepDetect, points", partial(find_points, points), version=version)
    dense = replace(ours, name="DeepDetect, dense tracks", tracks="dense")
    sift = SfmMethod("SIFT, pycolmap", find_sift, match_sift, refined=False)
    aligned = SfmMethod("SIFT, tracks refined", find_sift, match_sift)
    chance = SfmMethod(random, partial(find_random_points, points), version=version, chance=True)
    return [ours, dense, *([sift, aligned] if "sift" in options.classical else []), chance]


def _version(points: PointDetector) -> str:
    return f"{points.settings} {points.descriptor_type}"


def measure_scene(run: Run, method: SfmMethod, scene: PosedScene) -> Row:
    """Reconstruct a scene by a method, or read the result from the cache.

    Returns the values of `run_method` and the "scene". The keys "true" and "estimated" (for true
    and estimated intrinsics) hold a dict of the `MODEL_COLUMNS` and of "views", the registered
    cameras by file name.
    """
    images = tuple(image.path for image in scene.images)
    cameras = {image.name: image.camera for image in scene.images}
    depends = (
        (method.name, method.version),
        [(image.path, image.name, image.camera.matrix) for image in scene.images],
        repr(vars(OPTIONS)),
        import_pycolmap().__version__,
    )
    known = {} if scene.located_only else cameras
    row = run.cached("sfm", depends, lambda: run_in_child(run_method, method, images, known))
    row["scene"] = scene
    for kind in KINDS:
        poses = zip(row[f"{kind} names"].tolist(), row[f"{kind} poses"], strict=True)
        views = {
            name: PosedView(name, cameras[name], pose[:9].reshape(3, 3), pose[9:])
            for name, pose in poses
        }
        row[kind] = {"views": views, **{name: row[f"{kind} {name}"] for name in MODEL_COLUMNS}}
    return row


def dense_rows(run: Run, scene: PosedScene, detector: PointDetector) -> Rows:
    """Measure dense points of a scene by DeepDetect and SGBM, or read the rows from the cache."""
    images = tuple(image.path for image in scene.images)
    cameras = {image.name: image.camera for image in scene.images}
    known = {} if scene.located_only else cameras
    depends = (
        ("dense and SGBM", _version(detector)),
        (images, sorted(known.items())),
        import_pycolmap().__version__,
    )
    row = run.cached(
        "sfm", depends, lambda: run_in_child(measure_dense_points, images, known, detector)
    )
    sgbm = {name.removeprefix(f"{SGBM} "): row[name] for name in row if name.startswith(SGBM)}
    ours = {name: value for name, value in row.items() if not name.startswith(SGBM)}
    named = {"DeepDetect": ours, SGBM: sgbm}
    return [{"scene": scene.name, "depth maps": name, **row} for name, row in named.items()]


def camera_table(rows: Rows) -> Table:
    """Tabulate the errors of cameras and the sparse points of each method on each scene."""
    lines = []
    for row in rows:
        scene: PosedScene = row["scene"]
        truth = {image.name: image for image in scene.images}
        first = next((each for each in where(rows, scene=scene, method=rows[0]["method"])), row)
        for kind in KINDS:
            if scene.located_only and kind == "true":
                continue
            views = row[kind]["views"]
            line = {
                **{"scene": scene.name, "keypoints": row["method"], "intrinsics": kind},
                **{"images": len(scene.images), "registered": len(views)},
                **row[kind],
            }
            if not scene.located_only:
                errors = relative_pose_errors(views, truth)
                for each in POSE_THRESHOLDS_DEG:
                    line[f"AUC at {each:g}°"] = area_under_curve(errors, each)
            if len(views) >= MIN_IMAGES:
                true = [truth[name] for name in views]
                centres, rotations, _ = camera_errors(list(views.values()), true)
                line["centres, unit of the truth"] = float(centres.mean())
                if not scene.located_only:
                    line["rotations, °"] = float(rotations.mean())
            if first is not row:
                apart = _apart(views, first[kind]["views"], truth)
                line["from the first row's, unit of the truth"] = apart
            lines.append(line)
    return Table("sfm", "Cameras and sparse points", CAMERA_COLUMNS, lines, CAMERA_NOTE)


Views = Mapping[str, PosedView]


def _apart(views: Views, others: Views, truth: Views) -> float | None:
    """Align two models; return the mean distance of camera centres, in the ground truth's unit."""
    names = sorted(set(views) & set(others))
    if len(names) < MIN_IMAGES:
        return None
    own, other, true = ([each[name] for name in names] for each in (views, others, truth))
    unit = camera_errors(other, true)[2]
    return unit * float(camera_errors(own, other)[0].mean())


def find_points(detector: PointDetector, stages: Stages, folder: Path) -> None:
    """Write the ranked points of all images in a folder to a file, as `reconstruct_many` does."""
    stages.extract(folder, detector)


def find_random_points(detector: PointDetector, stages: Stages, folder: Path) -> None:
    """Write as many random points as there are ranked points, with their sizes in random order."""
    find_points(detector, stages, folder)
    with import_h5py().File(stages.features, "r+") as file:
        for number, name in enumerate(sorted(path.name for path in folder.iterdir())):
            rng = np.random.default_rng((0, number))
            group = file[name]
            width, height = (int(side) for side in group["image_size"][()])
            count = len(group["keypoints"])
            xy = rng.uniform(0, (width - 1, height - 1), (count, 2)).astype(np.float32)
            gray = luma(load_image(folder / name))
            sizes = rng.permutation(2 * group["scales"][()])
            scores, angles = rng.random(count, np.float32), dominant_angles(gray, xy, sizes)
            points = Keypoints(xy, scores, (width, height), sizes=sizes, angles=angles)
            made = feature_group(name, detector.describe(gray, points)).arrays
            for kind in ("keypoints", "descriptors", "scores", "scales", "oris"):
                group[kind][...] = made[kind]


def find_sift(stages: Stages, folder: Path) -> None:
    """Write keypoints of pycolmap's SIFT, with its defaults except for `max_num_features`.

    COLMAP drops the finest scales as long as at least `max_num_features` keypoints are left, so
    there may be more than `MAX_KEYPOINTS`.
    """
    names = sorted(path.name for path in folder.iterdir())
    with quiet_pycolmap() as pycolmap:
        how = pycolmap.FeatureExtractionOptions()
        how.num_threads = 1
        how.sift.max_num_features = MAX_KEYPOINTS
        pycolmap.extract_features(
            stages.work / DATABASE, folder, image_names=names, extraction_options=how
        )
        groups = []
        with pycolmap.Database.open(stages.work / DATABASE) as database:
            for image in database.read_all_images():
                camera = database.read_camera(image.camera_id)
                xy = np.asarray(database.read_keypoints(image.image_id))[:, :2] - PIXEL_CENTRE
                arrays = {
                    "keypoints": xy.astype(np.float32),
                    "image_size": np.array([camera.width, camera.height], np.int32),
                }
                groups.append(Group(image.name, arrays))
    write_groups(stages.features, groups)


def match_sift(stages: Stages, pairs: Sequence[Pair]) -> dict[Pair, np.ndarray]:
    """Match SIFT keypoints by pycolmap's matcher with its defaults. A later stage verifies them."""
    with quiet_pycolmap() as pycolmap:
        how = pycolmap.FeatureMatchingOptions()
        how.num_threads = 1
        how.skip_geometric_verification = True
        pycolmap.match_exhaustive(stages.work / DATABASE, matching_options=how)
        with pycolmap.Database.open(stages.work / DATABASE) as database:
            names = {image.image_id: image.name for image in database.read_all_images()}
            found: dict[Pair, np.ndarray] = {}
            for identifier, rows in zip(*database.read_all_matches(), strict=True):
                one, other = (names[k] for k in pycolmap.pair_id_to_image_pair(identifier))
                found[one, other] = np.asarray(rows, np.int64).reshape(-1, 2)
    nothing = np.empty((0, 2), np.int64)
    return {
        pair: found[pair] if pair in found else found.get(pair[::-1], nothing)[:, ::-1]
        for pair in pairs
    }


def run_method(method: SfmMethod, images: Sequence[Path], cameras: Mapping[str, Camera]) -> Row:
    """Reconstruct images by a method. Call it in a separate process.

    `cameras` are the true intrinsics by file name. Returns the `COST_COLUMNS` and, for true and
    estimated intrinsics, the values of `_unpacked` with the prefix "true " or "estimated ".
    """
    with tempfile.TemporaryDirectory(prefix="deepdetect-sfm-") as scratch:
        options = replace(OPTIONS, matches=method.tracks)
        stages = Stages(Path(scratch) / "model", options, 1, True)
        folder = stages.folder_of(images)
        start = _times()
        method.find(stages, folder)
        took = _times() - start
        with open_hdf5(stages.features) as file:
            sides = {name: file[name]["image_size"][()].tolist() for name in sorted(file)}
            counts = [len(file[name]["keypoints"]) for name in file]
        sizes = {name: (int(width), int(height)) for name, (width, height) in sides.items()}
        start = _times()
        pairs = stages.choose_pairs(list(sizes))
        matches = method.match(stages, pairs)
        took = (0 if method.chance else took) + _times() - start
        row = {
            "keypoints an image": float(np.mean(counts)),
            "matches": sum(len(rows) for rows in matches.values()),
            "keypoints and matches, s": took[0],
            "keypoints and matches, CPU s": took[1],
        }
        for kind, known in zip(KINDS, (cameras, {}), strict=True):
            intrinsics = initial_intrinsics(folder, sizes, known)
            model, seconds = None, np.nan
            if known or kind == "estimated":
                cpu = time.process_time()
                with contextlib.suppress(NoDepthError):  # a failed reconstruction is also a result
                    model = stages.map(folder, intrinsics, matches, bool(known), method.refined)[0]
                seconds = time.process_time() - cpu
            row[MAPPING_CPU.format(kind)] = seconds
            row |= {f"{kind} {name}": value for name, value in _unpacked(model).items()}
        return row | {"memory, MB": peak_memory() / 1e6}


def _times() -> np.ndarray:
    return np.array([time.perf_counter(), time.process_time()])


def _unpacked(model: Any) -> Row:
    """Return the values of a pycolmap model, or empty and NaN values without a model.

    "names" and "poses" have a row for each registered image. A row of "poses" has 9 numbers of the
    rotation and 3 of the translation.
    """
    columns: Row = {**dict.fromkeys(MODEL_COLUMNS, np.nan), "sparse points": 0}
    if model is None:
        return {"names": np.empty(0, np.str_), "poses": np.empty((0, 12)), **columns}
    sparse = read_sparse_model(model)
    views = sorted(sparse.views.values(), key=lambda view: view.name)
    if len(sparse.points):
        columns["sparse points"] = len(sparse.points)
        columns["track length"] = sparse.tracks.mean()
        columns["reprojection error, px"] = sparse.errors.mean()
    return {
        "names": [view.name for view in views],
        "poses": [[*view.rotation.ravel(), *np.ravel(view.translation)] for view in views],
        **columns,
    }
