from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from deepdetect import (
    DeepDetect,
    Keypoints,
    Matches,
    MatchingOptions,
    OptionError,
    PointDetector,
    SelectionOptions,
)
from deepdetect.detector.detector import find_keypoints
from deepdetect.evaluation.baselines.random import RandomDetector
from deepdetect.features import select_keypoints
from deepdetect.geometry import transfer_errors
from deepdetect.matching import PUBLISHED_MATCHING, pipeline

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
    by_rows = (
        matches.two_view_geometry is not None and matches.two_view_geometry.model == "fundamental"
    )
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
    assert matches.model in ("homography", "fundamental", "essential", "none")
    if matches.matrix is not None:
        assert (matches.matrix.shape, matches.matrix.dtype) == ((3, 3), np.float64)


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


PUBLISHED = {"options": PUBLISHED_MATCHING, "guided_matching": False, "model": "none"}


def unguided(*images: Any, **changes: Any) -> Matches:
    """Match by descriptors alone, whatever the options are otherwise."""
    return match(*images, **{**changes, "guided_matching": False})


def assert_same(one: Matches, other: Matches) -> None:
    for name in ("points0", "points1", "scores", "inliers"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    if one.matrix is None or other.matrix is None:
        assert one.matrix is other.matrix
    else:
        np.testing.assert_array_equal(one.matrix, other.matrix)
    assert one.model == other.model


@pytest.fixture(scope="module")
def network() -> DeepDetect:
    return DeepDetect()


@pytest.fixture(params=["stand-in", pytest.param("network", marks=pytest.mark.slow)])
def detector(request: pytest.FixtureRequest) -> Any:
    return Corners() if request.param == "stand-in" else request.getfixturevalue("network")


# Known geometry


@pytest.mark.parametrize("shift", [(0, 0), (9, 5)])
def test_a_shifted_photo_matches_itself(photo: np.ndarray, detector: Any, shift) -> None:
    dx, dy = shift
    first, second = photo, photo[dy:, dx:]
    matches = unguided(
        first, second, detector, density=0.1, ratio=0.8, mutual=True, model="homography"
    )
    truth = np.array([[1, 0, -dx], [0, 1, -dy], [0, 0, 1]])
    assert_well_formed(matches)
    assert len(matches) > 500
    assert share_correct(matches, truth, 0.1) > 0.9
    np.testing.assert_allclose(matches.matrix, truth, atol=0.05)
    np.testing.assert_array_equal(
        matches.inliers, transfer_errors(matches.points0, matches.points1, matches.matrix) < 1
    )


@pytest.mark.parametrize(("matcher", "descriptor"), [("flann", "sift"), ("exact", "rootsift")])
def test_a_warped_photo_matches_itself(
    photo: np.ndarray, detector: Any, descriptor: str, matcher: str
) -> None:
    second = warped(photo, WARP)
    matches = match(
        photo,
        second,
        detector,
        density=0.1,
        descriptor=descriptor,
        matcher=matcher,
        ratio=0.85,
        mutual=True,
        model="homography",
        inlier_threshold=2.0,
    )
    assert_well_formed(matches)
    assert len(matches) > 300
    assert share_correct(matches, WARP, 2) > 0.7
    # The model agrees with the truth all over the image, which moves by 20 pixels.
    points = photo.shape[0] * np.random.default_rng(0).random((500, 2))
    assert np.median(transfer_errors(points, warp_points(points), matches.matrix)) < 1
    # Its inliers are the correct matches, but for those near the threshold.
    correct = transfer_errors(matches.points0, matches.points1, WARP) < 2
    assert (matches.inliers == correct).mean() > 0.85


def warp_points(points: np.ndarray) -> np.ndarray:
    return cv2.perspectiveTransform(points[None].astype(np.float64), WARP)[0]


def test_a_given_homography_judges_the_matches(photo: np.ndarray) -> None:
    second = warped(photo, WARP)
    matches = unguided(
        photo, second, Corners(), density=0.05, homography=WARP, inlier_threshold=1.5
    )
    assert matches.model == "homography"
    np.testing.assert_array_equal(matches.matrix, WARP)
    errors = np.linalg.norm(warp_points(matches.points0) - matches.points1, axis=1)
    np.testing.assert_array_equal(matches.inliers, errors < 1.5)
    assert 0 < matches.inliers.sum() < len(matches)


# The whole pipeline, compared with one of OpenCV's own


def opencv_pipeline(
    maps: list[np.ndarray],
    images: list[np.ndarray],
    selection: SelectionOptions,
    options: MatchingOptions,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Keypoint objects, cv2.SIFT, a FLANN or brute-force matcher and a loop over its matches."""
    keypoints, descriptors = [], []
    for heatmap, image in zip(maps, images, strict=True):
        made = [
            cv2.KeyPoint(float(x), float(y), options.keypoint_size, options.angle)
            for x, y in select_keypoints(heatmap, selection).xy
        ]
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        made, described = cv2.SIFT_create().compute(gray, made)
        keypoints.append(made)
        descriptors.append(described)
    cv2.setRNGSeed(0)
    if options.matcher == "flann":
        matcher = cv2.FlannBasedMatcher({"algorithm": 1, "trees": 5}, {"checks": 50})
    else:
        matcher = cv2.BFMatcher(cv2.NORM_L2)
    found = matcher.knnMatch(*descriptors, k=2)
    kept = [
        (best, best.distance / second.distance)
        for best, second in found
        if best.distance < options.ratio * second.distance
    ]
    points0 = [keypoints[0][match.queryIdx].pt for match, _ in kept]
    points1 = [keypoints[1][match.trainIdx].pt for match, _ in kept]
    return np.array(points0), np.array(points1), np.array([ratio for _, ratio in kept])


@pytest.mark.parametrize(
    ("selection", "options"),
    [
        ({"density": 0.02}, {"ratio": 0.8}),
        ({"threshold": 0.8}, {"ratio": 0.9, "angle": -1.0}),
        ({"max_keypoints": 300}, {"matcher": "exact", "keypoint_size": 5.0}),
        ({"nms_radius": 2}, {"ratio": 0.7, "angle": 30.0, "matcher": "exact"}),
    ],
)
def test_equals_a_pipeline_of_opencv(
    photo: np.ndarray, selection: dict[str, Any], options: dict[str, Any]
) -> None:
    part = photo[50:200, 60:230]
    images = [part, warped(part, WARP)]
    corners = Corners()
    matches = unguided(*images, corners, **selection, **options)
    maps = [corners.heatmap(image) for image in images]
    points0, points1, ratios = opencv_pipeline(
        maps, images, SelectionOptions(**selection), MatchingOptions(**options)
    )
    assert len(matches) > 20
    np.testing.assert_array_equal(matches.points0, points0)
    np.testing.assert_array_equal(matches.points1, points1)
    np.testing.assert_allclose(matches.scores, 1 - ratios, atol=1e-5)


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
    settings: dict[str, Any] = {"two_view_model": guide, "density": 0.1, "mutual": True}
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
        product = found.two_view_geometry.matrix @ swapped.two_view_geometry.matrix
        np.testing.assert_allclose(product / product[2, 2], np.eye(3), atol=1e-6)
    else:
        np.testing.assert_allclose(
            found.two_view_geometry.matrix, swapped.two_view_geometry.matrix.T
        )


def test_mutual_leaves_one_to_one(photo: np.ndarray) -> None:
    second = warped(photo, WARP)
    every = unguided(photo, second, Corners(), density=0.02, matcher="exact")
    mutual = unguided(photo, second, Corners(), density=0.02, matcher="exact", mutual=True)
    assert 0 < len(mutual) < len(every)
    assert len(np.unique(mutual.points1, axis=0)) == len(mutual)
    assert len(np.unique(every.points1, axis=0)) < len(every)


@pytest.mark.parametrize(
    "values",
    [
        {"model": "homografy"},
        {"model": "essential"},
        {"homography": np.eye(2)},
        {"ignore": np.zeros((3, 3))},
        {"ignore": [None] * 3},
        {"tentative_matches": (np.zeros((4, 2)), np.zeros((5, 2)))},
        {"tentative_matches": ()},
        {"tentative_matches": (np.full((9, 2), np.nan), np.zeros((9, 2)))},
        {"two_view_model": "fundamental", "model": "homography"},
    ],
    ids=str,
)
def test_wrong_options(photo: np.ndarray, values: dict[str, Any]) -> None:
    with pytest.raises(OptionError):
        match(photo, photo, Corners(), **values)


# Detectors


@pytest.mark.parametrize("guided", [True, False])
def test_points_are_matched_at_their_sub_pixel_positions(photo: np.ndarray, guided: bool) -> None:
    moved = photo[5:, 9:]
    found = match(photo, moved, PointDetector(300), guided_matching=guided, ratio=0.85, mutual=True)
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


def test_points_of_a_turned_image_match_by_their_angles(photo: np.ndarray) -> None:
    turned = np.ascontiguousarray(np.rot90(photo))
    found = match(photo, turned, PointDetector(300), guided_matching=False, ratio=0.85, mutual=True)
    width = photo.shape[1]
    seen = np.column_stack([found.points0[:, 1], width - 1 - found.points0[:, 0]])
    right = np.linalg.norm(seen - found.points1, axis=1) < 1
    assert len(found) > 60
    assert right.mean() > 0.9


# Images


@pytest.mark.parametrize("settings", [{}, PUBLISHED], ids=["default", "published"])
@pytest.mark.parametrize("constant", [(True, True), (True, False), (False, True)])
def test_a_constant_image_has_no_matches(
    photo: np.ndarray, network: DeepDetect, settings: Any, constant: tuple[bool, bool]
) -> None:
    flat = np.full((48, 64, 3), 200, np.uint8)
    images = [flat if is_flat else photo[:64, :64] for is_flat in constant]
    matches = match(*images, network, **settings)
    assert_well_formed(matches)
    assert len(matches) == 0
    assert matches.matrix is None
    for keypoints, is_flat in zip((matches.keypoints0, matches.keypoints1), constant, strict=True):
        assert not is_flat or len(keypoints) == 0


@pytest.mark.parametrize("matcher", ["flann", "exact"])
@pytest.mark.parametrize("count", [1, 3])
def test_very_few_keypoints(photo: np.ndarray, matcher: str, count: int) -> None:
    matches = unguided(photo, photo, Corners(), max_keypoints=count, matcher=matcher, mutual=True)
    assert_well_formed(matches)
    assert len(matches) == (0 if count == 1 else count)
    np.testing.assert_array_equal(matches.points0, matches.points1)


def test_a_flat_stand_in_image_is_described_by_zeros_that_match_nothing() -> None:
    """Every descriptor is 0: all neighbours are at distance 0, and no ratio is under 1."""

    class Everywhere:
        def heatmap(self, image: Any) -> np.ndarray:
            return np.ones(image.shape[:2], np.float32)

    flat = np.full((20, 24), 90, np.uint8)
    for matcher in ("flann", "exact"):
        matches = unguided(flat, flat, Everywhere(), matcher=matcher, ratio=1)
        assert len(matches.keypoints0) == 480
        assert len(matches) == 0


# The result


def test_the_result_is_the_same_every_time(photo: np.ndarray, detector: Any) -> None:
    second = warped(photo, WARP)
    first = match(photo, second, detector, density=0.05)
    cv2.setRNGSeed(777)  # whatever ran before
    assert_same(match(photo, second, detector, density=0.05), first)


# The published numbers


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "correct"), [("leuven", 58_946), ("ubc", 39_891)])
def test_the_published_system_is_reproduced(shared: Path, scene: str, correct: int) -> None:
    """Correct matches of images 1 and 6 as measured with the authors' own code."""
    pytest.importorskip("torch")
    folder = shared / "data" / "oxford" / scene
    matches = match(
        folder / "img1.png",
        folder / "img6.png",
        DeepDetect(
            shared / "reference" / "published_matching.safetensors",
            resolution=480,
            network_channels="bgr",
        ),
        **PUBLISHED,
        homography=np.loadtxt(folder / "H1to6p"),
    )
    assert matches.model == "homography"
    assert matches.inliers.sum() == pytest.approx(correct, rel=0.03)


# Seeds, and pairs without a geometry


def test_seeds_take_the_place_of_our_own_matches(photo: np.ndarray) -> None:
    shift = np.array([[1, 0, 9.0], [0, 1, -4], [0, 0, 1]])
    second = warped(photo, shift)
    places = np.random.default_rng(0).uniform(20, 180, (40, 2))
    seeds = places, places + (9, -4)
    seeds[1][::4] = np.random.default_rng(1).uniform(20, 180, (10, 2))  # these are wrong
    matches = match(photo, second, RandomDetector(), tentative_matches=seeds)
    assert (matches.model, matches.two_view_geometry.tentative_matches) == ("homography", 40)
    assert share_correct(matches, shift, 1.01) > 0.99
    assert len(matches) > 1000


def test_seeds_that_do_not_agree_guide_nothing(photo: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    seeds = rng.uniform(0, 200, (40, 2)), rng.uniform(0, 200, (40, 2))
    matches = match(photo, photo, RandomDetector(), tentative_matches=seeds)
    assert not matches.success
    assert len(matches) == 0


def test_a_pair_without_a_geometry_has_no_matches() -> None:
    rng = np.random.default_rng(0)
    first, second = (rng.integers(0, 256, (80, 110, 3), np.uint8) for _ in range(2))
    matches = match(first, second, RandomDetector())
    assert not matches.success
    assert not matches.guided
    assert (len(matches), matches.model, matches.matrix) == (0, "none", None)
    assert match(first, second, RandomDetector(), guided_matching=False).success


def test_a_pair_without_a_geometry_needs_no_keypoints_before_they_are_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(0)
    first, second = (rng.integers(0, 256, (120, 160, 3), np.uint8) for _ in range(2))
    detector = DeepDetect()
    calls = []

    def counted(*arguments: Any) -> Keypoints:
        calls.append(arguments)
        return find_keypoints(*arguments)

    monkeypatch.setattr(pipeline, "find_keypoints", counted)
    matches = match(first, second, detector)
    assert not matches.success
    assert repr(matches) == "Matches(0 matches, as no geometry could be trusted)"
    assert len(calls) == 0
    found = matches.keypoints1
    assert matches.keypoints1 is found
    assert len(calls) == 1
    np.testing.assert_array_equal(found.xy, detector.detect(second).xy)
    again = pickle.loads(pickle.dumps(matches))
    np.testing.assert_array_equal(again.keypoints0.xy, detector.detect(first).xy)
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
    assert len(found) > 100
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
    options = {"guided_matching": False, "mutual": True} if way == "unguided" else {}
    first = match(views[0], views[1], detector, model="homography", **options)
    second = match(views[1], views[2], detector, model="homography", **options)
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


def test_patchmatch_refuses_points_with_scales(photo: np.ndarray) -> None:
    with pytest.raises(OptionError):
        match(photo, photo, PointDetector(200), guided_matching=False, matcher="patchmatch")
