from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from deepdetect import (
    DeepDetect,
    Matches,
    OptionError,
    PointDetector,
    match_features,
)
from deepdetect.geometry import transfer_errors
from deepdetect_lab.evaluation.baselines.random import RandomDetector

from .conftest import match

WARP = np.array([[0.99, 0.06, 4.0], [-0.05, 0.97, 12.0], [6e-5, -4e-5, 1.0]])


class Corners:
    """A stand-in for the network, with nothing but `heatmap`: how much of a corner a pixel is."""

    def __init__(self) -> None:
        self.seen: list[np.ndarray] = []

    def heatmap(self, image: Any) -> np.ndarray:
        self.seen.append(image)
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        strength = cv2.cornerMinEigenVal(gray, 3)
        return strength / (strength + np.float32(1e-3))


def warped(image: np.ndarray, homography: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    return cv2.warpPerspective(image, homography, (width, height), flags=cv2.INTER_CUBIC)


def share_correct(matches: Matches, homography: np.ndarray, pixels: float) -> float:
    errors = transfer_errors(matches.points0, matches.points1, homography)
    return float((errors < pixels).mean())


def assert_well_formed(matches: Matches) -> None:
    count = len(matches)
    model, matrix = matches.geometry.model, matches.geometry.matrix
    by_rows = model == "fundamental"
    for points, keypoints, whole in (
        (matches.points0, matches.keypoints0, True),
        (matches.points1, matches.keypoints1, not by_rows),
    ):
        assert (points.shape, points.dtype) == ((count, 2), np.float32)
        positions = set(map(tuple, keypoints.xy.tolist()))
        assert not whole or set(map(tuple, points.tolist())) <= positions
    assert_indices_fit(matches, exact=not by_rows)
    assert (matches.scores.shape, matches.scores.dtype) == ((count,), np.float32)
    assert ((matches.scores >= 0) & (matches.scores <= 1)).all()
    assert (matches.inliers.shape, matches.inliers.dtype) == ((count,), np.bool_)
    assert model in ("homography", "fundamental", "essential", "none")
    assert (matrix is None) == (model == "none")
    if matrix is not None:
        assert (matrix.shape, matrix.dtype) == ((3, 3), np.float64)


def assert_indices_fit(matches: Matches, *, exact: bool) -> None:
    """Indices are of the keypoints that are matched, or of those up to a pixel away."""
    for side in (0, 1):
        points, indices = getattr(matches, f"points{side}"), getattr(matches, f"indices{side}")
        xy = getattr(matches, f"keypoints{side}").xy
        assert (indices.shape, indices.dtype) == ((len(matches),), np.int32)
        known = indices >= 0
        if exact:
            assert known.all()
            np.testing.assert_array_equal(xy[indices], points)
            continue
        distances = np.linalg.norm(xy[indices[known]] - points[known], axis=1)
        assert (distances <= 1).all()
        for point in points[~known]:
            assert np.linalg.norm(xy - point, axis=1).min() > 1


def assert_same(one: Matches, other: Matches) -> None:
    for name in ("points0", "points1", "scores", "inliers"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    np.testing.assert_array_equal(one.geometry.matrix, other.geometry.matrix)
    assert one.geometry.evidence.log10_nfa == other.geometry.evidence.log10_nfa


@pytest.fixture(scope="module")
def network() -> DeepDetect:
    return DeepDetect()


@pytest.fixture(params=["stand-in", pytest.param("network", marks=pytest.mark.slow)])
def detector(request: pytest.FixtureRequest) -> Any:
    return Corners() if request.param == "stand-in" else request.getfixturevalue("network")


# Known geometry


def test_a_warped_photo_matches_itself(photo: np.ndarray, detector: Any) -> None:
    second = warped(photo, WARP)
    options: dict[str, Any] = {"model": "homography", "inlier_threshold": 2.0}
    matches = match(photo, second, detector, density=0.1, mutual=True, **options)
    assert_well_formed(matches)
    assert len(matches) > 300
    assert share_correct(matches, WARP, 2) > 0.7
    # The model agrees with the truth all over the image, which moves by 20 pixels.
    points = photo.shape[0] * np.random.default_rng(0).random((500, 2))
    assert np.median(transfer_errors(points, warp_points(points), matches.geometry.matrix)) < 1
    # Its inliers are the correct matches, but for those near the threshold.
    correct = transfer_errors(matches.points0, matches.points1, WARP) < 2
    assert (matches.inliers == correct).mean() > 0.85


def warp_points(points: np.ndarray) -> np.ndarray:
    return cv2.perspectiveTransform(points[None].astype(np.float64), WARP)[0]


def test_a_given_homography_judges_the_matches(photo: np.ndarray) -> None:
    second = warped(photo, WARP)
    matches = match(photo, second, Corners(), density=0.05, homography=WARP, inlier_threshold=0.5)
    assert matches.geometry.model == "homography"
    np.testing.assert_array_equal(matches.geometry.matrix, WARP)
    errors = np.linalg.norm(warp_points(matches.points0) - matches.points1, axis=1)
    assert not (matches.inliers & (errors >= 0.5)).any()
    assert 0 < matches.inliers.sum() < len(matches)


# Options


def test_selection_options_reach_both_images(photo: np.ndarray) -> None:
    ignore = np.zeros(photo.shape[:2], bool)
    ignore[:, :100] = True
    matches = match(photo, photo, Corners(), max_keypoints=50, ignore=ignore)
    for keypoints in (matches.keypoints0, matches.keypoints1):
        assert len(keypoints) == 50
        assert (keypoints.xy[:, 0] >= 100).all()


@pytest.mark.parametrize("guide", ["homography", "fundamental"])
def test_mutual_matches_do_not_depend_on_which_image_comes_first(
    photo: np.ndarray, guide: str
) -> None:
    first = photo[40:216, 40:216]
    second = warped(first, WARP)
    settings: dict[str, Any] = {"model": guide, "density": 0.1, "mutual": True}
    found = match(first, second, **settings)
    swapped = match(second, first, **settings)
    assert len(found) > 500
    pairs = [
        np.column_stack(points)
        for points in ((found.points0, found.points1), (swapped.points1, swapped.points0))
    ]
    np.testing.assert_array_equal(*(np.unique(each, axis=0) for each in pairs))
    assert share_correct(swapped, np.linalg.inv(WARP), 2) > 0.95
    if guide == "homography":
        product = found.geometry.matrix @ swapped.geometry.matrix
        np.testing.assert_allclose(product / product[2, 2], np.eye(3), atol=1e-6)
    else:
        np.testing.assert_allclose(found.geometry.matrix, swapped.geometry.matrix.T)


@pytest.mark.parametrize(
    "values",
    [
        {"model": "homografy"},
        {"model": "none"},
        {"model": "essential"},
        {"homography": np.eye(2)},
        {"ignore": np.zeros((3, 3))},
        {"ignore": [None] * 3},
        {"tentative_matches": (np.zeros((4, 2)), np.zeros((5, 2)))},
        {"tentative_matches": ()},
        {"tentative_matches": (np.full((9, 2), np.nan), np.zeros((9, 2)))},
        {"guided_matching": False},
    ],
    ids=str,
)
def test_wrong_options(photo: np.ndarray, values: dict[str, Any]) -> None:
    with pytest.raises(OptionError):
        match(photo, photo, Corners(), **values)


# Detectors


def test_points_are_matched_at_their_sub_pixel_positions(photo: np.ndarray) -> None:
    found = match(photo, photo[5:, 9:], PointDetector(300), mutual=True)
    assert found.keypoints0.sizes is not None
    assert len(found) > 100
    rows0 = {tuple(xy) for xy in found.keypoints0.xy.tolist()}
    rows1 = {tuple(xy) for xy in found.keypoints1.xy.tolist()}
    assert all(tuple(xy) in rows0 for xy in found.points0.tolist())
    assert all(tuple(xy) in rows1 for xy in found.points1.tolist())
    gaps = np.linalg.norm(found.points0 - (9, 5) - found.points1, axis=1)
    assert np.median(gaps) < 0.1


def test_points_are_no_pixels_to_be_selected(photo: np.ndarray) -> None:
    with pytest.raises(OptionError):
        match(photo, photo, PointDetector(), threshold=0.6)


# Images


@pytest.mark.parametrize("constant", [(True, True), (True, False), (False, True)])
def test_a_constant_image_has_no_matches(
    photo: np.ndarray, network: DeepDetect, constant: tuple[bool, bool]
) -> None:
    flat = np.full((48, 64, 3), 200, np.uint8)
    images = [flat if is_flat else photo[:64, :64] for is_flat in constant]
    matches = match(*images, network)
    assert_well_formed(matches)
    assert len(matches) == 0
    assert not matches.success
    for keypoints, is_flat in zip((matches.keypoints0, matches.keypoints1), constant, strict=True):
        assert not is_flat or len(keypoints) == 0


# The result


def test_the_result_is_the_same_every_time(photo: np.ndarray, detector: Any) -> None:
    second = warped(photo, WARP)
    first = match(photo, second, detector, density=0.05)
    cv2.setRNGSeed(777)  # whatever ran before
    assert_same(match(photo, second, detector, density=0.05), first)


# Seeds, and pairs without a geometry


def test_seeds_are_asked_before_our_own_matches(photo: np.ndarray) -> None:
    shift = np.array([[1, 0, 9.0], [0, 1, -4], [0, 0, 1]])
    second = warped(photo, shift)
    places = np.random.default_rng(0).uniform(20, 180, (40, 2))
    seeds = places, places + (9, -4)
    seeds[1][::4] = np.random.default_rng(1).uniform(20, 180, (10, 2))  # these are wrong
    matches = match(photo, second, RandomDetector(), tentative_matches=seeds)
    assert matches.geometry.model == "homography"
    assert matches.geometry.evidence.tentative_matches == 40
    assert share_correct(matches, shift, 1.01) > 0.99
    assert len(matches) > 1000


def test_seeds_that_do_not_agree_are_passed_over(photo: np.ndarray) -> None:
    """Then our own matches guide, as they do without seeds."""
    rng = np.random.default_rng(0)
    seeds = rng.uniform(0, 200, (40, 2)), rng.uniform(0, 200, (40, 2))
    shift = np.array([[1, 0, 9.0], [0, 1, -4], [0, 0, 1]])
    second = warped(photo, shift)
    matches = match(photo, second, RandomDetector(), tentative_matches=seeds)
    assert matches.success
    assert matches.geometry.evidence.tentative_matches != 40
    assert share_correct(matches, shift, 1.01) > 0.99
    unrelated = rng.integers(0, 256, photo.shape, np.uint8)
    assert not match(photo, unrelated, RandomDetector(), tentative_matches=seeds).success


def test_a_pair_without_a_geometry_has_no_matches() -> None:
    rng = np.random.default_rng(0)
    first, second = (rng.integers(0, 256, (80, 110, 3), np.uint8) for _ in range(2))
    matches = match(first, second, RandomDetector())
    assert not matches.success
    told = matches.geometry
    assert (told.model, told.matrix, told.scene, told.confidence) == ("none", None, "none", "none")
    assert len(matches) == 0


def test_a_pair_without_a_geometry_has_its_keypoints() -> None:
    rng = np.random.default_rng(0)
    first, second = (rng.integers(0, 256, (120, 160, 3), np.uint8) for _ in range(2))
    detector = DeepDetect()
    matches = match(first, second, detector)
    assert not matches.success
    assert repr(matches) == "Matches(0 matches; no geometry can be trusted)"
    again = pickle.loads(pickle.dumps(matches))
    for found in (matches, again):
        np.testing.assert_array_equal(found.keypoints0.xy, detector.detect(first).xy)
        np.testing.assert_array_equal(found.keypoints1.xy, detector.detect(second).xy)
    assert not again.success
    assert len(matches[:0]) == len(matches.unique()) == 0


@pytest.mark.parametrize(("mutual", "swapped"), [(False, False), (True, True)])
@pytest.mark.parametrize("detector", [None, PointDetector(600)], ids=["dense", "points"])
def test_indices_of_a_scene_with_depth(
    facade: Any, mutual: bool, swapped: bool, detector: Any
) -> None:
    scene = facade(0.2)
    images = [view[50:250, 60:340] for view in (scene.left, scene.right)][:: -1 if swapped else 1]
    found = match(*images, detector, model="fundamental", mutual=mutual)
    assert found.subpixel
    assert len(found) > 80
    assert_indices_fit(found, exact=False)
    # One end is at a keypoint, or on the pixel of one that is sub-pixel.
    ends = [
        (points, keypoints.xy[indices], indices)
        for points, keypoints, indices in (
            (found.points0, found.keypoints0, found.indices0),
            (found.points1, found.keypoints1, found.indices1),
        )
    ]
    if not mutual:
        ends = ends[:1]
    assert any(
        (indices >= 0).all() and (np.rint(xy) == points).all() for points, xy, indices in ends
    )
    share = min((found.indices0 >= 0).mean(), (found.indices1 >= 0).mean())
    assert share > (0.4 if detector else 0.8)


@pytest.mark.parametrize("way", ["dense", "unguided"])
def test_tracks_chain_by_their_indices(photo: np.ndarray, network: DeepDetect, way: str) -> None:
    """A keypoint of the image in the middle has one index, whatever the image is matched with."""
    there = np.array([[1, 0.02, -6.0], [-0.02, 1, 4], [0, 0, 1]])
    views = [warped(photo, move)[40:216, 40:216] for move in (np.eye(3), there, there @ there)]
    shift = np.array([[1, 0, 40.0], [0, 1, 40], [0, 0, 1]])
    twice = np.linalg.inv(shift) @ there @ there @ shift
    detector = network if way == "dense" else PointDetector(500)
    if way == "dense":
        first, second = (match(*views[k : k + 2], detector, model="homography") for k in (0, 1))
    else:
        features = [detector.extract(view) for view in views]
        first, second = (match_features(*features[k : k + 2]) for k in (0, 1))
    middle = first.keypoints1
    np.testing.assert_array_equal(middle.xy, second.keypoints0.xy)
    np.testing.assert_array_equal(middle.xy, detector.detect(views[1]).xy)
    onward = dict(zip(second.indices0.tolist(), second.indices1.tolist(), strict=True))
    tracks = [
        (int(a), onward[int(b)])
        for a, b in zip(first.indices0, first.indices1, strict=True)
        if int(b) in onward
    ]
    assert len(tracks) > 0.3 * min(len(first), len(second))
    start = first.keypoints0.xy[[a for a, _ in tracks]].astype(np.float64)
    end = second.keypoints1.xy[[c for _, c in tracks]]
    expected = cv2.perspectiveTransform(start[None], twice)[0]
    errors = np.linalg.norm(end - expected, axis=1)
    assert np.mean(errors < 3) > (0.6 if way == "unguided" else 0.9)


def test_images_of_opencv_are_matched_as_what_they_show(photo: np.ndarray) -> None:
    first, second = photo[:160, :160], photo[20:180, 30:190]
    bgr = [cv2.cvtColor(image, cv2.COLOR_RGB2BGR) for image in (first, second)]
    expected = match(first, second, model="homography")
    found = match(*bgr, channels="bgr", model="homography")
    np.testing.assert_array_equal(found.points0, expected.points0)
    np.testing.assert_array_equal(found.points1, expected.points1)
    np.testing.assert_array_equal(found.keypoints1.scores, expected.keypoints1.scores)
    with pytest.raises(OptionError, match="'brg'"):
        match(*bgr, channels="brg")


def test_a_logo_on_transparent_ground_is_found(shared: Path) -> None:
    """Its strokes are too thin for windows, so that the sparse matches decide alone."""
    case = shared / "cases" / "transparent-logo"
    expected = match(case / "logo-on-white.png", case / "photo.png").geometry.matrix
    found = match(case / "logo.png", case / "photo.png")
    assert found.geometry.confidence == "fair"
    assert len(found) > 5000
    assert (transfer_errors(found.points0, found.points1, expected) < 2).mean() > 0.98


def test_confidence_is_fair_if_more_stands_still_than_moves(shared: Path) -> None:
    case = shared / "cases" / "static-overlay"
    with pytest.warns(UserWarning, match="stands still"):
        found = match(case / "frame0.png", case / "frame1.png")
    assert found.geometry.evidence.left_out > 0.5
    assert found.geometry.confidence == "fair"
    moved = np.linalg.norm(found.points1 - found.points0, axis=1)
    assert moved.min() > 1
