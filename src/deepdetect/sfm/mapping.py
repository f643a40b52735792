"""Poses of all photographs and sparse points: COLMAP's incremental mapping, and a last refinement.

Schönberger and Frahm, "Structure-from-Motion Revisited", 2016.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import NoDepthError
from .._shared.options import check_ranges, suggest_keywords
from ..geometry.posed_view import PosedView
from .colmap import PIXEL_CENTRE, quiet_pycolmap
from .lens import Lens
from .pair_selection import largest_group

Pair = tuple[str, str]


@suggest_keywords
@dataclass(frozen=True)
class MappingOptions:
    """How poses and sparse points are estimated.

    Attributes:
        min_verified: matches of a pair that must agree with a two-view geometry.
        max_verification_error_px: of a match that agrees.
        min_views: of a model; smaller ones are given up.
        max_models: groups of photographs that do not hang together, of which models are made.
        max_first_pairs: pairs with which each of them may begin.
        forward_angle_deg: COLMAP begins with a pair whose points are seen at large angles, and
            which did not move straight ahead. Where there is none, as in a clip from a car, or
            where more photographs are left than mapped, it may have, and this angle is enough.
        robust_scale_px: of the loss (Cauchy) of the last adjustment: larger errors count less.
        min_views_of_principal_point: photographs of each camera from which that adjustment also
            estimates its principal point: with fewer it is in the middle.
        seed: of all random choices.

    Raises:
        OptionError: a value is out of its range.
    """

    min_verified: int = 15
    max_verification_error_px: float = 4.0
    min_views: int = 3
    max_models: int = 5
    max_first_pairs: int = 20
    forward_angle_deg: float = 4.0
    robust_scale_px: float = 1.0
    min_views_of_principal_point: int = 8
    seed: int = 0

    def __post_init__(self) -> None:
        check_ranges(
            self,
            positive=(
                *("min_verified", "max_verification_error_px"),
                *("robust_scale_px", "max_models", "max_first_pairs"),
                "forward_angle_deg",
            ),
            not_negative=("seed",),
            between={"min_views": (2, np.inf), "min_views_of_principal_point": (3, np.inf)},
        )


@dataclass(frozen=True, eq=False)
class Observations:
    """Where points are seen: one row for each point in each photograph that sees it.

    Attributes:
        points: (K,) int64 rows of the points, ascending.
        views: (K,) int64 numbers of the photographs.
        xy: (K, 2) float64 positions in pixels.
    """

    points: np.ndarray
    views: np.ndarray
    xy: np.ndarray


@dataclass(frozen=True, eq=False)
class SparseModel:
    """Cameras and sparse points, in the frame and unit of the model.

    Attributes:
        views: by COLMAP's number of the photograph; their cameras are pinhole cameras.
        lenses: of the photographs, by the same number, with their distortion.
        points: (P, 3) float64.
        errors: (P,) float64 mean reprojection error in pixels.
        seen: where they are seen by the pinhole cameras, ascending by point.
    """

    views: Mapping[int, PosedView]
    lenses: Mapping[int, Lens]
    points: np.ndarray
    errors: np.ndarray
    seen: Observations

    @property
    def tracks(self) -> np.ndarray:
        """(P,) number of photographs that each point is seen in."""
        return np.bincount(self.seen.points, minlength=len(self.points))


def verify_pairs(
    database: Path, options: MappingOptions, verified: Callable[[int], object] = lambda count: None
) -> dict[Pair, int]:
    """Estimate the two-view geometries of matched pairs, and store them in the database.

    Args:
        database: with matches.
        options: how.
        verified: called with 1 after each pair.

    Returns:
        The number of matches that agree with its geometry, of each pair where enough do.
    """
    found: dict[Pair, int] = {}
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(database) as opened:
        how = pycolmap.TwoViewGeometryOptions()
        how.min_num_inliers = options.min_verified
        how.ransac.max_error = options.max_verification_error_px
        how.ransac.random_seed = options.seed
        images = {image.image_id: image for image in opened.read_all_images()}
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        xy = {
            number: np.asarray(opened.read_keypoints(number), np.float64)[:, :2]
            for number in images
        }
        for identifier, matches in zip(*opened.read_all_matches(), strict=True):
            pair = pycolmap.pair_id_to_image_pair(identifier)
            views = [
                argument
                for number in pair
                for argument in (cameras[images[number].camera_id], xy[number])
            ]
            geometry = pycolmap.estimate_two_view_geometry(*views, matches, how)
            opened.write_two_view_geometry(*pair, geometry)
            if len(geometry.inlier_matches):
                names = images[pair[0]].name, images[pair[1]].name
                found[names] = len(geometry.inlier_matches)
            verified(1)
    return found


def map_photographs(
    database: Path,
    folder: Path,
    workspace: Path,
    known_cameras: bool,
    options: MappingOptions,
    registered: Callable[[int], object] = lambda count: None,
) -> tuple[Any, list[frozenset[str]]]:
    """Estimate the poses of as many photographs as hang together.

    Args:
        database: with verified matches.
        folder: of the photographs.
        workspace: an empty folder, for COLMAP's own files.
        known_cameras: whether the cameras stay as they are.
        options: how.
        registered: called with the number of photographs that were added.

    Returns:
        The largest model of pycolmap, and the names of the photographs in each of the others.

    Raises:
        NoDepthError: no photographs hang together.
    """
    with quiet_pycolmap() as pycolmap:
        how = pycolmap.IncrementalPipelineOptions()
        how.min_model_size = options.min_views
        how.max_num_models = options.max_models
        how.init_num_trials = options.max_first_pairs
        how.min_num_matches = options.min_verified
        how.extract_colors = False
        how.random_seed = options.seed
        if known_cameras:
            how.ba_refine_focal_length = False
            how.ba_refine_extra_params = False
        verified = _verified_pairs(pycolmap, database, options.min_verified)
        found: list[Any] = []
        for forward in (False, True):
            if forward:
                how.mapper.init_max_forward_motion = 1.0
                how.mapper.init_min_tri_angle = options.forward_angle_deg
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
            attempt = sorted(models.values(), key=lambda model: -model.num_reg_images())
            if _largest(attempt) > _largest(found):
                found = attempt
            # What is left may be more than the model: a drive beside some photographs of a house.
            mapped = frozenset[str]().union(*map(_names, found))
            left = [pair for pair in verified if mapped.isdisjoint(pair)]
            if found and largest_group(left) <= _largest(found):
                break
    if not found or found[0].num_reg_images() < options.min_views:
        raise NoDepthError(
            "the photographs do not hang together: take them so that each shows most of what the "
            "one before shows, from another place"
        )
    return found[0], [_names(model) for model in found[1:]]


def _largest(models: Sequence[Any]) -> int:
    """Return the number of photographs of the first of some models, the largest ones first."""
    return models[0].num_reg_images() if models else 0


def _verified_pairs(pycolmap: Any, database: Path, min_verified: int) -> list[Pair]:
    """Return the names of the pairs with enough matches that agree with their geometry."""
    with pycolmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        found = zip(*opened.read_two_view_geometry_num_inliers(), strict=True)
        pairs = [
            pycolmap.pair_id_to_image_pair(number)
            for number, count in found
            if count >= min_verified
        ]
    return [(names[first], names[second]) for first, second in pairs]


def _names(model: Any) -> frozenset[str]:
    return frozenset(model.images[number].name for number in model.reg_image_ids())


def read_sparse_model(model: Any, sources: Mapping[str, str] = {}) -> SparseModel:
    """Return the cameras and points of a model of pycolmap.

    Args:
        model: a `pycolmap.Reconstruction`.
        sources: where the intrinsics of each photograph began.
    """
    views, lenses = {}, {}
    for number in model.reg_image_ids():
        image = model.images[number]
        pose = image.cam_from_world()
        lens = Lens.of_colmap(image.camera, sources.get(image.name, "given"))
        lenses[number] = lens
        views[number] = PosedView(
            image.name, lens.pinhole, pose.rotation.matrix(), np.array(pose.translation)
        )
    numbers = sorted(model.points3D)
    rows = [
        (k, element.image_id, *model.images[element.image_id].points2D[element.point2D_idx].xy)
        for k, number in enumerate(numbers)
        for element in model.points3D[number].track.elements
    ]
    table = np.array(rows, np.float64).reshape(-1, 4)
    seen_in = table[:, 1].astype(np.int64)
    xy = table[:, 2:] - PIXEL_CENTRE
    for number, lens in lenses.items():
        own = seen_in == number
        xy[own] = lens.to_pinhole(xy[own])
    points = np.array([model.points3D[number].xyz for number in numbers]).reshape(-1, 3)
    seen = Observations(table[:, 0].astype(np.int64), seen_in, xy)
    errors = _mean_errors(points, views, seen)
    return SparseModel(views, lenses, points, errors, seen)


def _mean_errors(
    points: np.ndarray, views: Mapping[int, PosedView], seen: Observations
) -> np.ndarray:
    """Return the mean distance of each point's projections from where it is seen, in pixels."""
    distances = np.empty(len(seen.xy))
    for number, view in views.items():
        own = np.flatnonzero(seen.views == number)
        projected = view.project(points[seen.points[own]])[0]
        distances[own] = np.linalg.norm(projected - seen.xy[own], axis=1)
    sums = np.bincount(seen.points, distances, minlength=len(points))
    return sums / np.maximum(np.bincount(seen.points, minlength=len(points)), 1)


def adjust(
    model: Any, known_cameras: bool, scale_px: float, options: MappingOptions = MappingOptions()
) -> None:
    """Adjust all cameras and points (bundle adjustment) with a robust loss.

    Args:
        model: a `pycolmap.Reconstruction`, which is changed.
        known_cameras: whether the cameras stay as they are.
        scale_px: of the loss.
        options: when the principal point is estimated.
    """
    taken = Counter(model.images[number].camera_id for number in model.reg_image_ids())
    enough = min(taken.values()) >= options.min_views_of_principal_point
    with quiet_pycolmap() as pycolmap:
        how = pycolmap.BundleAdjustmentOptions()
        how.refine_focal_length = how.refine_extra_params = not known_cameras
        how.refine_principal_point = enough and not known_cameras
        how.print_summary = False
        how.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        how.ceres.loss_function_scale = scale_px
        pycolmap.bundle_adjustment(model, how)
        model.update_point_3d_errors()


def normalise_model(model: Any) -> str:
    """Bring a model into the frame of a camera in its middle; 1 is the spacing of its cameras.

    Args:
        model: a `pycolmap.Reconstruction`, which is changed.

    Returns:
        Name of the photograph whose camera it is: the one that sees most points.
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
    return view.name


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
