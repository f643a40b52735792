"""The keypoints whose reconstructions from many photographs are compared, and how these are made.

All go through the stages of `reconstruct_many` with the same options; only the keypoints, and for
SIFT the matches, are others. Each method runs in a process of its own, which tells its memory.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..._shared.errors import NoDepthError
from ...batch.extraction import feature_group
from ...batch.hdf5 import Group, import_h5py, open_hdf5, write_groups
from ...detector.point_detector import PointDetector
from ...features.keypoints import Keypoints
from ...features.scale_space import dominant_angles
from ...features.sift import describe_keypoints
from ...geometry.camera import Camera
from ...io.image import load_image, luma
from ...sfm.colmap import PIXEL_CENTRE, quiet_pycolmap
from ...sfm.intrinsics import initial_intrinsics
from ...sfm.mapping import read_sparse_model
from ...sfm.options import MultiViewOptions
from ...sfm.pipeline import MAX_KEYPOINTS
from ...sfm.stages import Stages
from ..profiling import peak_memory

FEATURES, DATABASE = "features.h5", "sift.db"

OPTIONS = MultiViewOptions(pairs="all")
"""Of all methods: those of `reconstruct_many`, but every pair is matched."""

KINDS = ("true", "estimated")
"""Intrinsics that models are made with."""

Pair = tuple[str, str]
Finder = Callable[[Stages, Path], None]
Matcher = Callable[[Stages, Sequence[Pair]], dict[Pair, np.ndarray]]


def match_features(stages: Stages, pairs: Sequence[Pair]) -> dict[Pair, np.ndarray]:
    """Match as `reconstruct_many` does."""
    return stages.match(pairs)


@dataclass(frozen=True)
class SfmMethod:
    """A row of the tables.

    Attributes:
        title: how tables name it.
        find: writes the keypoints of the photographs in a folder; a function of a module.
        match: returns the matches of pairs; a function of a module.
        depends: what results depend on besides the code, the photographs and the options.
        chance: the time it takes to find the points means nothing.
    """

    title: str
    find: Finder
    match: Matcher = match_features
    depends: str = ""
    chance: bool = False

    @property
    def name(self) -> str:
        """By which the rows know it."""
        return self.title


@dataclass(frozen=True, eq=False)
class SfmTask:
    """What a process is asked for.

    Attributes:
        method: whose keypoints.
        photographs: their files.
        cameras: the true cameras, by the names of the files.
    """

    method: SfmMethod
    photographs: tuple[Path, ...]
    cameras: Mapping[str, Camera]


@dataclass
class _Clock:
    seconds: float = 0.0
    cpu_seconds: float = 0.0

    @contextmanager
    def running(self) -> Iterator[None]:
        """Add what the block takes."""
        wall, own = time.perf_counter(), time.process_time()
        yield
        self.seconds += time.perf_counter() - wall
        self.cpu_seconds += time.process_time() - own


SFM_POINTS = PointDetector(MAX_KEYPOINTS)


def find_points(stages: Stages, folder: Path, detector: PointDetector = SFM_POINTS) -> None:
    """Find the ranked points, as `reconstruct_many` does.

    Args:
        stages: of the reconstruction.
        folder: of the photographs.
        detector: of the points.
    """
    stages.extract(folder, detector)


def find_random_points(
    stages: Stages, folder: Path, detector: PointDetector = SFM_POINTS, seed: int = 0
) -> None:
    """Put as many random points in place of the ranked ones.

    They get the sizes of these in another order, the dominant angle of the gradients there, and the
    same descriptor.
    """
    find_points(stages, folder, detector)
    with import_h5py().File(stages.work / FEATURES, "r+") as file:
        for number, name in enumerate(sorted(path.name for path in folder.iterdir())):
            rng = np.random.default_rng((seed, number))
            group = file[name]
            width, height = (int(side) for side in group["image_size"][()])
            count = len(group["keypoints"])
            xy = rng.uniform(0, (width - 1, height - 1), (count, 2)).astype(np.float32)
            gray = luma(load_image(folder / name))
            sizes = rng.permutation(2 * group["scales"][()])
            points = Keypoints(
                xy,
                rng.random(count, np.float32),
                (width, height),
                sizes=sizes,
                angles=dominant_angles(gray, xy, sizes),
            )
            made = feature_group(name, describe_keypoints(gray, points)).arrays
            for kind in ("keypoints", "descriptors", "scores", "scales", "oris"):
                group[kind][...] = made[kind]


def find_sift(stages: Stages, folder: Path) -> None:
    """Find keypoints by pycolmap's own SIFT with its defaults, at no more places than ours."""
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
    write_groups(stages.work / FEATURES, groups)


def match_sift(stages: Stages, pairs: Sequence[Pair]) -> dict[Pair, np.ndarray]:
    """Match by pycolmap's own matcher with its defaults; the verification is that of all."""
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


def run_method(task: SfmTask) -> dict[str, np.ndarray]:
    """Reconstruct images by a method; to be called in a process of its own.

    Returns:
        By name "keypoints", mean number in an image, "matches", of all pairs together, "seconds"
        and "cpu seconds" of both, "memory", the most bytes that the process held; for each kind of
        intrinsics the "names", "poses" and "numbers" of `_map`.
    """
    with tempfile.TemporaryDirectory(prefix="deepdetect-sfm-") as scratch:
        stages = Stages(Path(scratch) / "model", OPTIONS, 1, True)
        folder = stages.folder_of(task.photographs)
        clock = _Clock()
        with clock.running():
            task.method.find(stages, folder)
        if task.method.chance:
            clock = _Clock()
        sizes, counts = _sizes_and_counts(stages.work / FEATURES)
        names = sorted(sizes)
        with clock.running():
            matches = task.method.match(stages, stages.choose_pairs(names))
        values: dict[str, Any] = {
            "keypoints": np.mean(counts),
            "matches": sum(len(rows) for rows in matches.values()),
            "seconds": clock.seconds,
            "cpu seconds": clock.cpu_seconds,
        }
        for kind, known in zip(KINDS, (task.cameras, {}), strict=True):
            model = _map(stages, folder, names, sizes, matches, known)
            values |= {f"{kind} {name}": array for name, array in model.items()}
        values["memory"] = peak_memory()
        return {name: np.asarray(value) for name, value in values.items()}


def _sizes_and_counts(path: Path) -> tuple[dict[str, tuple[int, int]], list[int]]:
    with open_hdf5(path) as file:
        sides = {name: file[name]["image_size"][()].tolist() for name in file}
        sizes = {name: (int(width), int(height)) for name, (width, height) in sides.items()}
        return sizes, [len(file[name]["keypoints"]) for name in file]


def _map(
    stages: Stages,
    folder: Path,
    names: Sequence[str],
    sizes: Mapping[str, tuple[int, int]],
    matches: Mapping[Pair, np.ndarray],
    known: Mapping[str, Camera],
) -> dict[str, Any]:
    """Map with known cameras, or with those that are estimated; no model is a result, too.

    Returns:
        The "names" of the registered images, (N, 12) "poses", rotation and translation, and
        "numbers": sparse points, mean track length, mean reprojection error and CPU seconds.
    """
    intrinsics = initial_intrinsics(folder, {name: sizes[name] for name in names}, known)
    clock = _Clock()
    try:
        with clock.running():
            model, _, _ = stages.map(folder, intrinsics, matches, bool(known))
    except NoDepthError:
        numbers = (0, np.nan, np.nan, clock.cpu_seconds)
        return {"names": np.empty(0, np.str_), "poses": np.empty((0, 12)), "numbers": numbers}
    sparse = read_sparse_model(model)
    views = sorted(sparse.views.values(), key=lambda view: view.name)
    return {
        "names": [view.name for view in views],
        "poses": [[*view.rotation.ravel(), *np.ravel(view.translation)] for view in views],
        "numbers": (
            len(sparse.points),
            sparse.tracks.mean(),
            sparse.errors.mean(),
            clock.cpu_seconds,
        ),
    }
