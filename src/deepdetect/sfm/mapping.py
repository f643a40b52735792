"""Poses of all images and sparse points: COLMAP's incremental mapping, and a last adjustment.

Schönberger and Frahm, "Structure-from-Motion Revisited", 2016.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import NoDepthError
from ..batch.pair_list import Pair
from ..geometry.camera import PosedView
from .colmap import PIXEL_CENTRE, quiet_pycolmap
from .intrinsics import CameraIntrinsics
from .pair_selection import largest_component

MIN_VERIFIED = 15
"""Matches of a pair that must agree with a two-view geometry."""

MAX_VERIFICATION_ERROR_PX = 4.0
"""Of a match that agrees."""

MIN_VIEWS = 3
"""Of a model; smaller ones are given up."""

MAX_MODELS = 5
"""Components of images that do not hang together, of which models are made."""

MAX_FIRST_PAIRS = 20
"""With which each of them may begin."""

FORWARD_ANGLE_DEG = 4.0
"""COLMAP begins with a pair whose points are seen at large angles, and which did not move straight
ahead. Where there is none, as in a clip from a car, or where more images are left than mapped, it
may have, and this angle is enough."""

ROBUST_SCALE_PX = 1.0
"""Of the loss (Cauchy) of the last adjustment: larger errors count less."""

MIN_VIEWS_OF_PRINCIPAL_POINT = 8
"""Images of each camera from which that adjustment also estimates its principal point: with fewer
it is in the middle."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Where points are seen: one row for each point in each image that sees it.

    Attributes:
        points: (K,) int64 rows of the points, ascending.
        views: (K,) int64 COLMAP's numbers of the images.
        xy: (K, 2) float64 positions in pixels of pinhole cameras.
        keypoints: (K,) int64 rows of the keypoints of the image.
    """

    points: np.ndarray
    views: np.ndarray
    xy: np.ndarray
    keypoints: np.ndarray


@dataclass(frozen=True, eq=False)
class SparseModel:
    """Cameras and sparse points, in the frame and unit of the model.

    Attributes:
        views: by COLMAP's number of the image; their cameras are pinhole cameras.
        intrinsics: of the images, by the same number, with their distortion.
        points: (P, 3) float64.
        errors: (P,) float64 mean reprojection error in pixels.
        seen: where they are seen.
    """

    views: Mapping[int, PosedView]
    intrinsics: Mapping[int, CameraIntrinsics]
    points: np.ndarray
    errors: np.ndarray
    seen: Observations

    @property
    def tracks(self) -> np.ndarray:
        """(P,) number of images that each point is seen in."""
        return np.bincount(self.seen.points, minlength=len(self.points))


def verify_pairs(database: Path, seed: int = 0, workers: int | None = None) -> dict[Pair, int]:
    """Estimate the two-view geometries of matched pairs, and store them in the database.

    Args:
        database: with matches.
        seed: of the random samples.
        workers: number of threads; None: one per processor.

    Returns:
        The number of matches that agree with its geometry, of each pair where enough do.
    """
    with quiet_pycolmap() as pycolmap:
        how = pycolmap.TwoViewGeometryOptions(min_num_inliers=MIN_VERIFIED)
        how.ransac.max_error = MAX_VERIFICATION_ERROR_PX
        how.ransac.random_seed = seed
        verifier = pycolmap.GeometricVerifierOptions(num_threads=workers or -1)
        pairing = pycolmap.ExistingMatchedPairingOptions()
        pycolmap.geometric_verification(database, verifier, pairing, how)
        with pycolmap.Database.open(database) as opened:
            names = {image.image_id: image.name for image in opened.read_all_images()}
            numbers = zip(*opened.read_two_view_geometry_num_inliers(), strict=True)
            pairs = [(pycolmap.pair_id_to_image_pair(pair), count) for pair, count in numbers]
    return {(names[a], names[b]): count for (a, b), count in pairs if count >= MIN_VERIFIED}


def map_images(
    database: Path,
    folder: Path,
    workspace: Path,
    verified: Iterable[Pair],
    known_cameras: bool,
    seed: int = 0,
    registered: Callable[[int], object] = lambda count: None,
) -> tuple[Any, list[frozenset[str]]]:
    """Estimate the poses of as many images as hang together.

    Args:
        database: with verified matches.
        folder: of the images.
        workspace: an empty folder, for COLMAP's own files.
        verified: pairs with enough matches that agree with a geometry.
        known_cameras: whether the intrinsics stay as they are.
        seed: of all random choices.
        registered: called with the number of images that were added.

    Returns:
        The largest model of pycolmap, and the names of the images in each other component.

    Raises:
        NoDepthError: no images hang together.
    """
    with quiet_pycolmap() as pycolmap:
        how = pycolmap.IncrementalPipelineOptions()
        how.min_model_size = MIN_VIEWS
        how.max_num_models = MAX_MODELS
        how.init_num_trials = MAX_FIRST_PAIRS
        how.min_num_matches = MIN_VERIFIED
        how.extract_colors = False
        how.random_seed = seed
        if known_cameras:
            how.ba_refine_focal_length = False
            how.ba_refine_extra_params = False
        found: list[Any] = []
        for forward in (False, True):
            if forward:
                how.mapper.init_max_forward_motion = 1.0
                how.mapper.init_min_tri_angle = FORWARD_ANGLE_DEG
            space = workspace / str(int(forward))
            space.mkdir()
            models = pycolmap.incremental_mapping(
                database,
                folder,
                space,
                how,
                initial_image_pair_callback=lambda: registered(2),
                next_image_callback=lambda: registered(1),
            )
            attempt = sorted(models.values(), key=_size, reverse=True)
            if not found or (attempt and _size(attempt[0]) > _size(found[0])):
                found = attempt
            # What is left may be more than the model: a drive beside some images of a house.
            mapped = frozenset[str]().union(*map(_names, found))
            left = [pair for pair in verified if mapped.isdisjoint(pair)]
            if found and largest_component(left) <= _size(found[0]):
                break
    if not found or _size(found[0]) < MIN_VIEWS:
        raise NoDepthError(
            "the images do not hang together: take them so that each shows most of what the "
            "one before shows, from another place"
        )
    return found[0], [_names(model) for model in found[1:]]


def _size(model: Any) -> int:
    return int(model.num_reg_images())


def _names(model: Any) -> frozenset[str]:
    return frozenset(model.images[number].name for number in model.reg_image_ids())


def read_sparse_model(model: Any, sources: Mapping[str, str] = {}) -> SparseModel:
    """Return the cameras and points of a model of pycolmap.

    Args:
        model: a `pycolmap.Reconstruction`.
        sources: where the intrinsics of each image began.
    """
    views, intrinsics = {}, {}
    for number in model.reg_image_ids():
        image = model.images[number]
        pose = image.cam_from_world()
        own = CameraIntrinsics.of_colmap(image.camera, sources.get(image.name, "given"))
        intrinsics[number] = own
        views[number] = PosedView(
            image.name, own.pinhole, pose.rotation.matrix(), np.array(pose.translation)
        )
    numbers = sorted(model.points3D)
    rows = [
        (
            *(k, element.image_id, element.point2D_idx),
            *model.images[element.image_id].points2D[element.point2D_idx].xy,
        )
        for k, number in enumerate(numbers)
        for element in model.points3D[number].track.elements
    ]
    table = np.array(rows, np.float64).reshape(-1, 5)
    seen_points, seen_in, keypoints = table[:, :3].astype(np.int64).T
    xy = table[:, 3:] - PIXEL_CENTRE
    for number, own in intrinsics.items():
        rows_in = seen_in == number
        xy[rows_in] = own.to_pinhole(xy[rows_in])
    points = np.array([model.points3D[number].xyz for number in numbers]).reshape(-1, 3)
    seen = Observations(seen_points, seen_in, xy, keypoints)
    distances = np.empty(len(xy))
    for number, view in views.items():
        rows_in = seen_in == number
        projected = view.project(points[seen_points[rows_in]])[0]
        distances[rows_in] = np.linalg.norm(projected - xy[rows_in], axis=1)
    counts = np.bincount(seen_points, minlength=len(points))
    errors = np.bincount(seen_points, distances, minlength=len(points)) / np.maximum(counts, 1)
    return SparseModel(views, intrinsics, points, errors, seen)


def adjust(model: Any, known_cameras: bool) -> None:
    """Adjust all cameras and points (bundle adjustment) with a robust loss.

    Args:
        model: a `pycolmap.Reconstruction`, which is changed.
        known_cameras: whether the intrinsics stay as they are.
    """
    taken = Counter(model.images[number].camera_id for number in model.reg_image_ids())
    enough = min(taken.values()) >= MIN_VIEWS_OF_PRINCIPAL_POINT
    with quiet_pycolmap() as pycolmap:
        how = pycolmap.BundleAdjustmentOptions()
        how.refine_focal_length = how.refine_extra_params = not known_cameras
        how.refine_principal_point = enough and not known_cameras
        how.print_summary = False
        how.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        how.ceres.loss_function_scale = ROBUST_SCALE_PX
        pycolmap.bundle_adjustment(model, how)
        model.update_point_3d_errors()


def normalise_model(model: Any) -> None:
    """Bring a `pycolmap.Reconstruction` into the frame of the camera that sees most points.

    1 is the spacing of its cameras.
    """
    sparse = read_sparse_model(model)
    seen = np.bincount(sparse.seen.views)
    number = max(sparse.views, key=lambda number: seen[number])
    view = sparse.views[number]
    scale = 1 / (camera_spacing(list(sparse.views.values())) or 1.0)
    with quiet_pycolmap() as pycolmap:
        model.transform(
            pycolmap.Sim3d(
                scale, pycolmap.Rotation3d(view.rotation), scale * np.asarray(view.translation)
            )
        )


def camera_spacing(views: Sequence[PosedView]) -> float:
    """Return the median distance from a camera to the nearest other one."""
    centres = np.array([view.centre for view in views])
    distances = np.linalg.norm(centres[:, None] - centres, axis=2)
    np.fill_diagonal(distances, np.inf)
    return float(np.median(distances.min(axis=1)))


def write_sparse_model(model: Any, folder: Path) -> None:
    """Write COLMAP's files of a model into a folder, all of them or none."""
    made = folder.with_name(f".{folder.name}.new")
    before = folder.with_name(f".{folder.name}.old")
    for leftover in (made, before):
        shutil.rmtree(leftover, ignore_errors=True)
    made.mkdir(parents=True)
    model.write(made)
    if folder.exists():
        folder.rename(before)
    made.rename(folder)
    shutil.rmtree(before, ignore_errors=True)
