"""Estimate all poses and the sparse points by COLMAP's mapping and a final bundle adjustment.

Incremental mapping: Schönberger and Frahm, "Structure-from-Motion Revisited", 2016. Global mapping:
Pan, Baráth, Pollefeys and Schönberger, "Global Structure-from-Motion Revisited", 2024.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import NoDepthError
from ..batch.pair_list import Pair, largest_component
from ..geometry.camera import PosedView, camera_spacing
from ..geometry.lens import MIN_DEVIATIONS, UNDISTORT, deviations
from ..geometry.similarity import Similarity
from .colmap import PIXEL_CENTRE, CameraIntrinsics, quiet_pycolmap

MIN_VERIFIED = 30
"""A pair of images is used only if its two-view geometry has at least this many inliers. Unrelated
images of 8,192 keypoints have about 20, and slowed the mapping of mixed folders down tenfold."""

MAX_VERIFICATION_ERROR_PX, MAX_TRIALS = 4.0, 5000
"""An inlier's error is at most MAX_VERIFICATION_ERROR_PX (COLMAP's default). RANSAC draws at most
MAX_TRIALS samples: with COLMAP's 10,000, unrelated pairs would take longer than the mapping."""

MIN_VIEWS = 3
"""A model needs at least this number of images. For two images, there is `reconstruct`."""

MAX_MODELS, MAX_FIRST_PAIRS = 5, 20
"""Unconnected groups of images become at most MAX_MODELS models. For each model, at most
MAX_FIRST_PAIRS pairs of images are tried as the first pair. Chosen by hand."""

FORWARD_ANGLE_DEG = 4.0
"""The mapping begins with two images whose lines of sight form over 16 degrees, and between which
the camera did not move straight ahead, as in COLMAP. If no pair qualifies, or more connected images
are left out than mapped, a retry allows forward motion and angles down to this. Chosen by hand."""

ROBUST_SCALE_PX, MAX_REFINED_ERROR_PX = 1.0, 1.0
"""`ROBUST_SCALE_PX` is the scale of the Cauchy loss in bundle adjustment, chosen by hand. In
refined tracks, observations with errors above `MAX_REFINED_ERROR_PX` are removed as wrong."""

ROUGH_TOLERANCE, TOLERANCE = 1e-6, 1e-8
"""Bundle adjustment ends when a step reduces the cost by less than this fraction. `ROUGH_TOLERANCE`
is used before wrong observations are removed. Smaller tolerances move cameras by under a thousandth
of their error, and take four times as long."""

MIN_ANGLE_DEG = 1.0
"""Two lines of sight to each point must form at least this angle (COLMAP: 1.5). Chosen by hand."""

MIN_FOCAL_RATIO, MAX_FOCAL_RATIO, MAX_DISTORTION = 0.1, 10.0, 1.0
"""COLMAP's limits for plausible cameras: for the ratio of the focal length to the image's longer
side, and for the absolute values of the distortion parameters."""

MIN_VIEWS_OF_PRINCIPAL_POINT = 8
"""Principal points are estimated only if each camera took at least this number of images.
Otherwise, they are the middle of the image. Chosen by hand."""

USUAL_DISTORTION = 0.05
"""A lens may be a fisheye if it moves the image corners inwards by more than this fraction of their
distance from the centre. SLRs stay below this, fisheyes of 100 degrees reach 0.14."""

LENSES = {"RADIAL": (0.0, 0.0), "RADIAL_FISHEYE": (1 / 3, 2 / 15)}
"""Compared models and initial distortion: by the series of tan, a fisheye starts as a pinhole."""


@dataclass(frozen=True, eq=False)
class RegisteredImage:
    """An image with its pose and the sparse points that it sees.

    `points` (K,) are ascending indices of the model's points. `xy` (K, 2) are their keypoints in
    this image, in undistorted pixels (of the pinhole camera of `view`).
    """

    view: PosedView
    intrinsics: CameraIntrinsics
    points: np.ndarray
    xy: np.ndarray


@dataclass(frozen=True, eq=False)
class SparseModel:
    """Cameras and sparse points, in the frame and unit of the model.

    `images` are by name, in COLMAP's order. `points` (P, 3) have uint8 sRGB `colors` (P, 3) and
    mean reprojection `errors` (P,) in pixels. `tracks` (P,) counts the images that see each point.
    """

    images: Mapping[str, RegisteredImage]
    points: np.ndarray
    colors: np.ndarray
    errors: np.ndarray
    tracks: np.ndarray

    @property
    def views(self) -> dict[str, PosedView]:
        """The posed camera of each image, by name of the image."""
        return {name: image.view for name, image in self.images.items()}

    def common_points(self, image: RegisteredImage) -> list[int]:
        """Count, for each image of the model, the points that it shares with the given image."""
        seen = np.zeros(len(self.points), bool)
        seen[image.points] = True
        return [int(seen[other.points].sum()) for other in self.images.values()]


def verify_pairs(database: Path, seed: int = 0, workers: int | None = None) -> dict[Pair, int]:
    """Store the two-view geometries of matched pairs; return the inlier count by verified pair.

    Verified pairs have at least `MIN_VERIFIED` inliers, not only on a watermark at the border.
    """
    with quiet_pycolmap() as pycolmap:
        how = pycolmap.TwoViewGeometryOptions(min_num_inliers=MIN_VERIFIED)
        how.ransac.max_error = MAX_VERIFICATION_ERROR_PX
        how.ransac.random_seed, how.ransac.max_num_trials = seed, MAX_TRIALS
        verifier = pycolmap.GeometricVerifierOptions(num_threads=workers or -1)
        pairing = pycolmap.ExistingMatchedPairingOptions()
        pycolmap.geometric_verification(database, verifier, pairing, how)
        with pycolmap.Database.open(database) as opened:
            names = {image.image_id: image.name for image in opened.read_all_images()}
            pairs = [
                (pycolmap.pair_id_to_image_pair(pair), len(found.inlier_matches))
                for pair, found in zip(*opened.read_two_view_geometries(), strict=True)
                if found.config != pycolmap.TwoViewGeometryConfiguration.WATERMARK
            ]
    return {(names[a], names[b]): count for (a, b), count in pairs if count >= MIN_VERIFIED}


def map_images(
    database: Path,
    folder: Path,
    verified: Iterable[Pair],
    known_cameras: bool,
    seed: int = 0,
    registered: Callable[[int], object] = lambda count: None,
) -> tuple[Any, list[frozenset[str]]]:
    """Estimate the poses of connected images one after the other, from verified pairs.

    With `known_cameras`, all intrinsics stay fixed; without, they do so in a last attempt, if two
    images alone gave intrinsics that fit no third image. `registered` gets the number of images
    just added. Returns the largest `pycolmap.Reconstruction`, and the image names of each other
    model.
    """
    with quiet_pycolmap() as pycolmap:
        how = pycolmap.IncrementalPipelineOptions()
        how.min_model_size = MIN_VIEWS
        how.max_num_models = MAX_MODELS
        how.init_num_trials = MAX_FIRST_PAIRS
        how.min_num_matches = MIN_VERIFIED
        how.extract_colors, how.ignore_watermarks = False, True
        how.random_seed = seed
        if known_cameras:
            how.max_focal_length_ratio = np.inf  # COLMAP's limit is too low for telescopes
        usual = how.mapper.init_max_forward_motion, how.mapper.init_min_tri_angle
        forward = 1.0, FORWARD_ANGLE_DEG
        attempts = [(usual, known_cameras), (forward, known_cameras)]
        # Two images alone may give a wrong focal length, with which no third image fits.
        attempts += [] if known_cameras else [(usual, True)]
        found, tried = list[Any](), list[Any]()
        for first_pair, fixed in attempts:
            if fixed and not known_cameras and any(_size(each) >= MIN_VIEWS for each in tried):
                break
            how.mapper.init_max_forward_motion, how.mapper.init_min_tri_angle = first_pair
            how.ba_refine_focal_length = how.ba_refine_extra_params = not fixed
            with tempfile.TemporaryDirectory(prefix="deepdetect-") as space:
                models = pycolmap.incremental_mapping(
                    database,
                    folder,
                    space,
                    how,
                    initial_image_pair_callback=lambda: registered(2),
                    next_image_callback=lambda: registered(1),
                )
            tried.extend(models.values())
            attempt = _sound(models, known_cameras)
            if not found or (attempt and _size(attempt[0]) > _size(found[0])):
                found = attempt
            # The images left out may form a larger component, for example of another scene.
            mapped = frozenset[str]().union(*map(_names, found))
            left = [pair for pair in verified if mapped.isdisjoint(pair)]
            if found and largest_component(left) <= _size(found[0]):
                break
    return _largest(found, tried)


def map_globally(
    database: Path, folder: Path, known_cameras: bool, seed: int = 0
) -> tuple[Any, list[frozenset[str]]]:
    """Estimate the poses of all images at once. Arguments and results are as in `map_images`."""
    with quiet_pycolmap() as pycolmap, tempfile.TemporaryDirectory(prefix="deepdetect-") as space:
        how = pycolmap.GlobalPipelineOptions()
        how.min_model_size, how.min_num_matches, how.random_seed = MIN_VIEWS, MIN_VERIFIED, seed
        how.ignore_watermarks = True
        if known_cameras:
            how.mapper.bundle_adjustment.refine_focal_length = False
            how.mapper.bundle_adjustment.refine_extra_params = False
        models = pycolmap.global_mapping(database, folder, space, how)
    return _largest(_sound(models, known_cameras), [*models.values()])


def _sound(models: Mapping[int, Any], known_cameras: bool) -> list[Any]:
    """Return the models, largest first, except those in which most cameras became implausible."""
    limits, found = (MIN_FOCAL_RATIO, MAX_FOCAL_RATIO, MAX_DISTORTION), []
    for model in models.values():
        cameras = [model.images[number].camera for number in model.reg_image_ids()]
        bogus = sum(camera.has_bogus_params(*limits) for camera in cameras)
        if known_cameras or 2 * bogus <= len(cameras):
            found.append(model)
    return sorted(found, key=_size, reverse=True)


def _largest(found: Sequence[Any], tried: Sequence[Any]) -> tuple[Any, list[frozenset[str]]]:
    """Return the first of the sound models `found`, and the image names of each other model."""
    if not found and any(_size(model) >= MIN_VIEWS for model in tried):
        raise NoDepthError(
            "focal length and distortion cannot be estimated from these images: give `calibration` "
            "or `focal_px`, or take more images, also from other sides"
        )
    if not found or _size(found[0]) < MIN_VIEWS:
        raise NoDepthError(
            "the images do not overlap enough to be connected: take each image from a new place, "
            "but so that it shows most of what the previous image shows"
        )
    return found[0], [_names(model) for model in found[1:]]


def _size(model: Any) -> int:
    return int(model.num_reg_images())


def _names(model: Any) -> frozenset[str]:
    return frozenset(model.images[number].name for number in model.reg_image_ids())


def read_sparse_model(model: Any, sources: Mapping[str, str] = {}) -> SparseModel:
    """Convert a `pycolmap.Reconstruction`; `sources` gives `CameraIntrinsics.source` by image."""
    points = np.empty((len(model.points3D), 3))
    colors = np.empty(points.shape, np.uint8)
    row_of = {}
    for row, number in enumerate(sorted(model.points3D)):
        row_of[number] = row
        points[row], colors[row] = model.points3D[number].xyz, model.points3D[number].color
    images = {}
    sums, tracks = np.zeros(len(points)), np.zeros(len(points), np.int64)
    for number in model.reg_image_ids():
        image = model.images[number]
        pose = image.cam_from_world()
        own = CameraIntrinsics.of_colmap(image.camera, sources.get(image.name, "given"))
        rotation, translation = pose.rotation.matrix(), np.array(pose.translation)
        view = PosedView(image.name, own.pinhole, rotation, translation)
        seen = sorted((row_of[p.point3D_id], *p.xy) for p in image.points2D if p.has_point3D())
        rows, *places = np.array(seen).reshape(-1, 3).T
        rows = rows.astype(np.int64)
        xy = own.to_pinhole(np.column_stack(places) - PIXEL_CENTRE)
        images[image.name] = RegisteredImage(view, own, rows, xy)
        distances = np.linalg.norm(view.project(points[rows])[0] - xy, axis=1)
        sums += np.bincount(rows, distances, len(points))
        tracks += np.bincount(rows, minlength=len(points))
    return SparseModel(images, points, colors, sums / np.maximum(tracks, 1), tracks)


def adjust(model: Any, known_cameras: bool, tolerance: float = TOLERANCE) -> None:
    """Bundle-adjust a model with a robust loss, and without the log of pycolmap's own function."""
    taken = Counter(model.images[number].camera_id for number in model.reg_image_ids())
    enough = min(taken.values()) >= MIN_VIEWS_OF_PRINCIPAL_POINT
    with quiet_pycolmap() as pycolmap:
        how = pycolmap.BundleAdjustmentOptions()
        how.refine_focal_length = how.refine_extra_params = not known_cameras
        how.refine_principal_point = enough and not known_cameras
        how.print_summary = False
        how.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        how.ceres.loss_function_scale = ROBUST_SCALE_PX
        how.ceres.solver_options.function_tolerance = tolerance
        pycolmap.ObservationManager(model).filter_observations_with_negative_depth()
        config = pycolmap.BundleAdjustmentConfig()
        for number in model.reg_image_ids():
            config.add_image(number)
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        pycolmap.create_default_bundle_adjuster(how, config, model).solve()
        model.update_point_3d_errors()


def adjust_refined(model: Any, known_cameras: bool) -> None:
    """Twice remove wrong observations from a model with refined tracks, and bundle-adjust it."""
    for max_error_px, tolerance in (
        (MAX_VERIFICATION_ERROR_PX, ROUGH_TOLERANCE),
        (MAX_REFINED_ERROR_PX, TOLERANCE),
    ):
        with quiet_pycolmap() as pycolmap:
            pycolmap.ObservationManager(model).filter_all_points3D(max_error_px, MIN_ANGLE_DEG)
        adjust(model, known_cameras, tolerance)


def require_pinholes(model: Any) -> None:
    """Raise a NoDepthError if fisheye lenses fit better than a model's "SIMPLE_RADIAL" cameras."""
    costs = []
    for name, added in LENSES.items():
        with quiet_pycolmap() as pycolmap:
            fitted, suspects = pycolmap.Reconstruction(model), 0
        for camera in fitted.cameras.values():
            focal, *centre, bend = camera.params
            if bend * (np.linalg.norm(centre) / focal) ** 2 < -USUAL_DISTORTION:
                camera.model = getattr(pycolmap.CameraModelId, name)
                camera.params = [focal, *centre, bend + added[0], added[1]]
                suspects += 1
        if not suspects:
            return
        adjust(fitted, False, ROUGH_TOLERANCE)
        # Errors are limited, because a few wrong points can have errors of any size.
        errors = {
            n: min(each.error, MAX_VERIFICATION_ERROR_PX) for n, each in fitted.points3D.items()
        }
        costs.append({n: np.log1p(error**2) for n, error in errors.items()})
    common = costs[0].keys() & costs[1].keys()
    pinhole, fisheye = (np.array([each[n] for n in common]) for each in costs)
    if deviations(pinhole, fisheye) > MIN_DEVIATIONS:
        raise NoDepthError(
            f"these images are from a fisheye lens, which no pinhole geometry fits: {UNDISTORT}"
        )


def normalise_model(model: Any) -> None:
    """Use the camera that sees most points as a model's frame, `camera_spacing` as its unit."""
    sparse = read_sparse_model(model)
    view = max(sparse.images.values(), key=lambda image: len(image.points)).view
    centres = np.array([each.centre for each in sparse.views.values()])
    scale = 1 / (camera_spacing(centres) or 1.0)
    own = Similarity(scale, view.rotation, scale * np.asarray(view.translation))
    transform_model(model, own)


def transform_model(model: Any, similarity: Similarity) -> None:
    """Apply a similarity to a `pycolmap.Reconstruction`."""
    with quiet_pycolmap() as pycolmap:
        rotation = pycolmap.Rotation3d(similarity.rotation)
        model.transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.translation))
