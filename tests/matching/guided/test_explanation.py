"""Guided matching as a whole: what it finds, and that it says so where it finds nothing."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import skimage.data

from deepdetect import (
    DeepDetect,
    ImageError,
    Keypoints,
    PointDetector,
    estimate_geometry,
    match_images,
)
from deepdetect.features.matches import GuidedMatches, TwoViewGeometry
from deepdetect.geometry import transform_points
from deepdetect.geometry.transforms import epipolar_errors, transfer_errors
from deepdetect.io.image import load_image, luma
from deepdetect.matching.guided import Explanation, ImagePair
from deepdetect_lab.datasets.middlebury import load_middlebury
from deepdetect_lab.datasets.posed_images import PosedPair, load_posed_scenes
from deepdetect_lab.evaluation.acceptance import synthetic
from deepdetect_lab.evaluation.metrics.pose import translation_error
from deepdetect_lab.evaluation.metrics.stereo import stereo_score
from deepdetect_lab.evaluation.protocols.pose import estimate_pose
from deepdetect_lab.evaluation.unguided import UPRIGHT_SIFT, match_unguided

from ..conftest import match
from .conftest import WARP


class Everywhere:
    """A detector that marks two pixels of three."""

    def heatmap(self, image: Any) -> np.ndarray:
        height, width = np.asarray(image).shape[:2]
        row, column = np.indices((height, width))
        return ((row + 2 * column) % 3 > 0).astype(np.float32)


def explained(
    grays: tuple[np.ndarray, np.ndarray], xy: np.ndarray
) -> tuple[TwoViewGeometry, GuidedMatches | None]:
    """Return the geometry and the matches of keypoints that are the same in both images."""
    keypoints0, keypoints1 = (Keypoints(xy, np.ones(len(xy)), gray.shape[::-1]) for gray in grays)
    return Explanation(ImagePair(grays), (keypoints0, keypoints1)).answer()


def test_nearly_all_points_of_a_plane_are_matched_right(
    photo: np.ndarray, second: np.ndarray
) -> None:
    matches = match(photo, second, Everywhere())
    assert matches.success
    assert matches.geometry.model == "homography"
    errors = np.linalg.norm(transform_points(matches.points0, WARP) - matches.points1, axis=1)
    assert (errors < 1).mean() > 0.99
    places = transform_points(matches.keypoints0.xy, WARP)
    seen = ((places > 0) & (places < 255)).all(1)
    assert len(matches) > 0.85 * seen.sum()
    assert ((matches.scores > 0) & (matches.scores <= 1)).all()
    assert matches.inliers.mean() > 0.95
    assert matches.geometry.confidence == "high"
    assert matches.geometry.evidence.verified > 0.8
    assert matches.geometry.evidence.correlation > 0.9
    assert len(np.unique(matches.points0, axis=0)) == len(matches)


@pytest.mark.slow
@pytest.mark.parametrize("pair", ["fountain 0-5", "fountain 3-10", "clip 24-44", "clip 19-44"])
def test_a_plane_guides_no_scene_with_depth(shared: Path, pair: str) -> None:
    name, numbers = pair.split()
    if name == "fountain":
        images = [shared / f"data/fountain/{int(n):04d}.jpg" for n in numbers.split("-")]
    else:
        images = [shared / f"data/kitti-clip/{int(n):06d}.jpg" for n in numbers.split("-")]
    matches = match(*images, density=0.02)
    assert matches.geometry.model != "homography"


@pytest.mark.parametrize(
    ("folder", "names", "model"),
    [
        *((f"middlebury/{name}", "left right", "fundamental") for name in ("art", "cones")),
        *(
            pytest.param(f"middlebury/{name}", "left right", "fundamental", marks=pytest.mark.slow)
            for name in ("teddy", "rocks", "cloth", "dolls", "moebius")
        ),
        ("oxford/graf", "img1 img3", "homography"),
        pytest.param("oxford/wall", "img1 img3", "homography", marks=pytest.mark.slow),
        ("oxford/boat", "img1 img2", "homography"),
        ("photos", "unrelated", "none"),
    ],
)
def test_the_model_is_that_of_the_scene(shared: Path, folder: str, names: str, model: str) -> None:
    if model == "none":
        images = skimage.data.astronaut(), skimage.data.coffee()
    else:
        paths = [next((shared / "data" / folder).glob(f"{name}.*")) for name in names.split()]
        images = tuple(load_image(path) for path in paths)
    found = match_images(*images, PointDetector(2000))
    assert found.geometry.model == model
    assert found.success == (model != "none")


def test_a_small_plane_is_matched_and_nothing_else(photo: np.ndarray) -> None:
    # A poster that fills a sixth of an otherwise different picture, and all of the first one.
    gray = luma(photo)[20:236, 20:236]
    other = np.random.default_rng(0).integers(0, 256, gray.shape).astype(np.uint8)
    other[65:151, 65:151] = gray[65:151, 65:151]
    grays = gray, other
    every = np.stack(np.meshgrid(np.arange(216), np.arange(216)), -1).reshape(-1, 2)
    # Few keypoints have another where the plane would take them; that decides nothing.
    for fraction in (1.0, 0.05):
        xy = every[np.random.default_rng(1).random(len(every)) < fraction]
        poster = ((xy >= 65) & (xy < 151)).all(axis=1)
        guide, found = explained(grays, xy)
        assert guide.scene in ("planar", "rotation", "still")
        errors = np.linalg.norm(found.points1 - xy[found.indices0], axis=1)
        assert (poster[found.indices0] & (errors < 1)).mean() > 0.95
        assert len(found) > 0.3 * np.count_nonzero(poster)  # the rest of it is smooth


def test_sparse_matches_have_the_indices_of_keypoints_up_to_a_pixel_away(
    photo: np.ndarray,
) -> None:
    """Nearly all keypoints are of what the other image does not show, so none is predicted."""
    first = luma(photo)
    second = np.random.default_rng(0).integers(0, 256, first.shape).astype(np.uint8)
    second[:, :160] = first[:, 96:]
    unseen, few, every = (
        np.stack(np.meshgrid(np.arange(*x), np.arange(*y)), -1).reshape(-1, 2)
        for x, y in (((0, 80), (0, 256)), ((120, 140, 3), (90, 120, 3)), ((0, 160), (0, 256)))
    )
    sides = np.concatenate([unseen, few]), every
    keypoints0, keypoints1 = (Keypoints(xy, np.ones(len(xy)), (256, 256)) for xy in sides)
    _, found = Explanation(ImagePair((first, second)), (keypoints0, keypoints1)).answer()
    starts = found.starts(keypoints0.xy)
    assert np.median(np.linalg.norm(found.points1 + [96, 0] - starts, axis=1)) < 1
    distances = np.linalg.norm(keypoints0.xy - starts[:, None], axis=2)
    known = found.indices0 >= 0
    assert (distances[known, found.indices0[known]] <= 1).all()
    assert (distances[~known].min(axis=1) > 1).all()


@pytest.mark.parametrize("side", [140, 230])
def test_a_plane_that_moves_otherwise_keeps_its_matches_and_spoils_no_others(
    shared: Path, photo: np.ndarray, side: int
) -> None:
    pair = load_middlebury(shared / "data" / "middlebury" / "cones")
    grays = left, right = luma(pair.left), luma(pair.right)
    poster = cv2.resize(luma(photo), (side, side), interpolation=cv2.INTER_AREA)
    left[20 : 20 + side, 10 : 10 + side] = right[130 : 130 + side, 220 : 220 + side] = poster
    every = np.stack(np.meshgrid(np.arange(0, 450, 2), np.arange(0, 375, 2)), -1).reshape(-1, 2)
    guide, found = explained(grays, every)
    assert guide.scene.startswith("depth") or side > 200  # the larger poster explains most
    assert len(guide.layers) >= 2
    starts = every[found.indices0]
    moved = found.points1 - starts
    of_poster = (np.abs(moved - (210, 110)) < 1).all(axis=1)
    assert np.count_nonzero(of_poster) > 0.7 * (side / 2) ** 2
    own = np.bincount(found.layer[of_poster]).argmax()
    assert (found.layer == own)[of_poster].mean() > 0.97
    assert of_poster[found.layer == own].mean() > 0.97
    beside = (starts > 20 + side).any(axis=1)
    assert np.count_nonzero(beside) > 0.2 * len(every)
    # Close around the larger poster, which explains most, some keypoints count as part of it.
    assert (np.abs(moved[beside, 1]) < 1).mean() > (0.98 if side < 200 else 0.92)


def test_of_two_motions_alike_in_size_neither_is_trusted_highly(photo: np.ndarray) -> None:
    # A view that turns within a frame that moves by itself.
    column, row = np.meshgrid(np.arange(256), np.arange(256))
    through = (np.hypot(column - 128, row - 128) < 100)[..., None]
    shift, turn = np.float64([[1, 0, 7], [0, 1, 4]]), cv2.getRotationMatrix2D((128, 128), 20, 1)
    frame = photo[::-1, ::-1]
    moved, turned = (
        cv2.warpAffine(image, by, (256, 256), flags=cv2.INTER_CUBIC)
        for image, by in ((frame, shift), (photo, turn))
    )
    views = (np.where(through, photo, frame), np.where(through, turned, moved))
    matches = match(*views, Everywhere())
    for motion in (shift, turn):
        errors = transfer_errors(matches.points0, matches.points1, np.vstack([motion, [0, 0, 1]]))
        assert 0.33 < (errors < 1).mean() < 0.67
    assert matches.geometry.confidence == "fair"


def turned_view(degrees: float, fisheye: bool) -> np.ndarray:
    """A view of a room of photographs by a camera that turns in its middle."""
    first, second = skimage.data.astronaut(), cv2.resize(skimage.data.coffee(), (512, 512))
    room = np.hstack([first, second, first[:, ::-1]])
    x, y = np.meshgrid(np.arange(640) - 319.5, np.arange(480) - 239.5)
    radius = np.hypot(x, y)
    angle = radius / 400 * np.radians(80) if fisheye else np.arctan(radius / 400)
    rays = np.dstack([np.sin(angle) * x / radius, np.sin(angle) * y / radius, np.cos(angle)])
    longitude = np.arctan2(rays[..., 0], rays[..., 2]) + np.radians(degrees)
    latitude = np.arcsin(rays[..., 1])
    places = (longitude / np.pi + 1) * 768, (latitude / np.pi + 0.5) * 512
    return cv2.remap(room, *np.float32(places), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)


def test_a_turned_camera_has_a_homography_unless_its_lens_is_a_fisheye() -> None:
    assert match_images(turned_view(0, False), turned_view(12, False)).geometry.scene == "rotation"
    with pytest.raises(ImageError):
        match_images(turned_view(0, True), turned_view(12, True))


def test_a_frame_that_stands_still_is_no_motion(photo: np.ndarray) -> None:
    column, row = np.meshgrid(np.arange(256), np.arange(256))
    through = (np.hypot(column - 128, row - 128) < 100)[..., None]
    turn = cv2.getRotationMatrix2D((128, 128), 20, 1)
    turned = cv2.warpAffine(photo, turn, (256, 256), flags=cv2.INTER_CUBIC)
    views = (np.where(through, view, photo[::-1, ::-1]) for view in (photo, turned))
    with pytest.warns(UserWarning, match="stands still"):
        matches = match(*views, Everywhere())
    errors = transfer_errors(matches.points0, matches.points1, np.vstack([turn, [0, 0, 1]]))
    assert (errors < 1).mean() > 0.95


@pytest.mark.parametrize(("number", "seed"), [(14, 0), (32, 0), (16, 2), (38, 1)])
def test_a_still_overlay_of_a_scene_that_is_not_found_is_not_trusted_highly(
    shared: Path, number: int, seed: int
) -> None:
    """20 or 40 % of the image is a texture that stands still; the scene behind it moves far."""
    pair = next(islice(synthetic.overlays(shared / "data"), number, None))
    found = match_images(*pair.make(), seed=seed)
    assert found.geometry is not None
    assert found.geometry.confidence != "high" or pair.truth.judge(found) == "right"


@pytest.mark.filterwarnings("ignore:.*stands still")
def test_matches_off_a_plane_of_a_facade_are_no_motion_of_their_own(shared: Path) -> None:
    """A wrong matrix of 73 matches off the second plane of entry 1-5 replaced one of 628."""
    pair = next(islice(synthetic.frames(shared / "data"), 5, None))
    found = match_images(*pair.make())
    assert pair.truth.pose_error(found.points0, found.points1) < 1


@pytest.mark.slow
@pytest.mark.parametrize(("number", "times"), [(1, 5), (8, 2)])
def test_a_dominant_plane_does_not_hide_the_depth_beside_it(
    shared: Path, number: int, times: int
) -> None:
    (scene,) = load_posed_scenes(shared / "data" / "entry")
    first, second = scene.images[0 if number == 1 else 2], scene.images[number]
    matches = match(first.path, second.path)
    guide = matches.geometry
    assert guide.model == "fundamental"
    assert guide.scene == "depth with a dominant plane"
    assert guide.evidence.on_plane > times * guide.evidence.off_plane > 10_000
    pair = PosedPair("entry", first, second)
    errors = epipolar_errors(matches.points0, matches.points1, pair.fundamental)
    assert (errors < 3).mean() > 0.99
    pose = estimate_pose(
        matches.points0, matches.points1, first.camera.matrix, second.camera.matrix
    )
    assert pose is not None
    assert translation_error(pose[1], pair.translation) < 1


@pytest.mark.slow
def test_depth_explains_as_much_as_a_plane_that_is_a_part_of_it(shared: Path) -> None:
    """Few matches off both planes of this pair fit to a matrix by which it explains less."""
    (scene,) = load_posed_scenes(shared / "data" / "entry")
    first, second = scene.images[0], scene.images[5]
    matches = match(first.path, second.path)
    pair = PosedPair("entry", first, second)
    errors = epipolar_errors(matches.points0, matches.points1, pair.fundamental)
    assert len(matches) > 100_000
    assert (errors < 3).mean() > 0.99


@pytest.mark.slow
def test_a_wall_that_repeats_hides_no_depth(shared: Path) -> None:
    """Displaced copies of the brick wall behind this fountain explain it as well as it does."""
    (scene,) = load_posed_scenes(shared / "data" / "fountain")
    first, second = scene.images[8], scene.images[10]
    matches = match(first.path, second.path)
    errors = epipolar_errors(
        matches.points0, matches.points1, PosedPair("fountain", first, second).fundamental
    )
    assert len(matches) > 50_000
    assert (errors < 3).mean() > 0.99


@pytest.mark.slow
def test_a_scene_with_depth_is_matched_near_its_epipolar_lines(shared: Path) -> None:
    pair = load_middlebury(shared / "data" / "middlebury" / "cones")
    detector = DeepDetect("dense")
    guided = match(pair.left, pair.right, detector)
    how = {"descriptor": UPRIGHT_SIFT, "matcher": "patchmatch"}
    unguided = match_unguided(pair.left, pair.right, detector, **how)
    unguided = unguided.with_geometry(estimate_geometry(unguided))
    assert guided.subpixel
    assert not unguided.subpixel
    assert guided.geometry.model == "fundamental"
    # The lines are estimated: near a corner they may be some rows off.
    assert (np.abs(guided.points0[:, 1] - guided.points1[:, 1]) <= 2).mean() > 0.98
    score = stereo_score(guided.points0, guided.points1, pair.disparity)
    plain = stereo_score(
        unguided.points0[unguided.inliers], unguided.points1[unguided.inliers], pair.disparity
    )
    assert score["correct"] > plain["correct"]
    assert score["precision"] > plain["precision"] + 0.03


@pytest.mark.slow
@pytest.mark.parametrize("name", ["art", "cones"])
def test_a_plane_that_is_asked_for_guides(shared: Path, name: str) -> None:
    """In scenes with depth, where nothing else would choose a plane."""
    pair = load_middlebury(shared / "data" / "middlebury" / name)
    for asked, expected in (("homography", "homography"), ("auto", "fundamental")):
        matches = match(pair.left, pair.right, Everywhere(), model=asked)
        assert matches.geometry.model == expected


@pytest.mark.slow
@pytest.mark.parametrize("model", ["fundamental", "essential"])
def test_who_asks_for_depth_gets_no_plane(facade: Any, model: str) -> None:
    """A homography explains nine tenths of the matches, and would drop what stands before."""
    pair = facade(0.07)
    camera = pair.camera
    detector = DeepDetect("dense")
    images = pair.left, pair.right, detector
    assert match(*images).geometry.scene == "depth with a dominant plane"
    found = match(*images, model=model, camera0=camera, camera1=camera)
    assert found.geometry.model == model
    assert found.geometry.scene.startswith("depth")
    x, y = found.points0.astype(int).T
    near = pair.near[y, x]
    assert near.sum() > 1000
    errors = np.linalg.norm(found.points1 - pair.match(found.points0), axis=1)
    for part in (near, ~near):
        assert (errors[part] < 2).mean() > 0.9
