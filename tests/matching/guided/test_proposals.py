"""Hypotheses of pairs whose geometry is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import skimage.data

from deepdetect.geometry import transform_points
from deepdetect.geometry.transforms import epipolar_errors
from deepdetect.io.image import luma
from deepdetect.matching.guided import ImagePair, Sources, Tentative
from deepdetect.matching.guided.proposals import planes, propose
from deepdetect_lab.evaluation.metrics.homography import corner_error

from .conftest import WARP


def test_learned_matches_of_a_moved_photograph_give_its_homography(
    warped_pair: ImagePair,
) -> None:
    matches = Sources(warped_pair).learned
    errors = np.linalg.norm(transform_points(matches.points0, WARP) - matches.points1, axis=1)
    assert (errors < 2).mean() > 0.9
    found = propose(warped_pair, matches, "homography", 0)
    assert corner_error(found.matrix, WARP, (256, 256)) < 2
    assert (found.errors(*found.points) <= found.threshold_px).all()
    assert np.count_nonzero(found.inliers) > 0.9 * len(matches.points0)


def test_matches_of_reduced_copies_lie_in_the_images_at_their_own_sizes(
    photo: np.ndarray,
) -> None:
    """The first image is larger than the copy in which it is matched, the second is not."""
    large = cv2.resize(luma(photo), (960, 960), interpolation=cv2.INTER_CUBIC)
    small = luma(photo)
    expected = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]]) @ np.diag([256 / 960] * 2 + [1])
    pair = ImagePair((large, small))
    found = propose(pair, Sources(pair).learned, "homography", 0)
    assert corner_error(found.matrix, expected, (960, 960)) < 2
    back = propose(pair.swapped(), Sources(pair.swapped()).learned, "homography", 0)
    assert back.tentative.pixel == pytest.approx(960 / 640)
    assert corner_error(back.matrix, np.linalg.inv(expected), (256, 256)) < 2


def test_two_halves_that_move_differently_give_two_homographies() -> None:
    first = luma(skimage.data.astronaut())
    shift = np.array([[1, 0, -12], [0, 1, 7], [0, 0, 1.0]])
    turn = np.vstack([cv2.getRotationMatrix2D((384, 256), 14, 1), [0, 0, 1]])
    left, right = (
        cv2.warpPerspective(first, each, (512, 512), flags=cv2.INTER_CUBIC)
        for each in (shift, turn)
    )
    pair = ImagePair((first, np.hstack([left[:, :256], right[:, 256:]])))
    found = list(planes(pair, Sources(pair).learned, 0))
    assert len(found) >= 2
    corners = np.array([[20, 20], [230, 20], [230, 490], [20, 490]])
    for plane, expected, places in zip(
        found, (shift, turn), (corners, corners + [256, 0]), strict=False
    ):
        gaps = transform_points(places, plane.matrix) - transform_points(places, expected)
        assert np.linalg.norm(gaps, axis=1).max() < 2
    assert not (found[0].inliers & found[1].inliers).any()


@pytest.mark.parametrize("model", ["homography", "fundamental"])
def test_unrelated_photographs_give_nothing(model: str) -> None:
    pair = ImagePair((luma(skimage.data.astronaut()), luma(skimage.data.coffee())))
    matches = Sources(pair).learned
    assert propose(pair, matches, model, 0) is None
    assert not list(planes(pair, matches, 0))


@pytest.mark.parametrize("model", ["homography", "fundamental"])
def test_too_few_matches_give_nothing(warped_pair: ImagePair, model: str) -> None:
    points0 = np.random.default_rng(0).uniform(30, 200, (7, 2))
    few = Tentative(points0, transform_points(points0, WARP))
    assert propose(warped_pair, few, model, 0) is None
    assert not list(planes(warped_pair, few, 0))


def test_given_positions_are_asked_first(warped_pair: ImagePair) -> None:
    places = np.stack(np.meshgrid(np.arange(30, 200, 20), np.arange(30, 200, 20)), -1)
    points0 = places.reshape(-1, 2).astype(np.float64)
    points1 = transform_points(points0, WARP)
    given = next(iter(Sources(warped_pair, (points0, points1))))
    np.testing.assert_array_equal(given.points0, points0)
    np.testing.assert_array_equal(given.points1, points1)
    found = propose(warped_pair, given, "homography", 0)
    assert corner_error(found.matrix, WARP, (256, 256)) < 0.1


def test_positions_that_are_given_many_times_are_one_match(warped_pair: ImagePair) -> None:
    """A hundred votes for one place are no more evidence than one."""
    points0 = np.repeat([[40.0, 60], [90, 30], [150, 180], [200, 90]], 100, axis=0)
    given = next(iter(Sources(warped_pair, (points0, points0 + [9, 4]))))
    assert len(given.points0) == 4
    assert propose(warped_pair, given, "homography", 0) is None


def test_a_scene_with_depth_gives_a_fundamental_matrix(facade) -> None:
    scene = facade(0.3)
    pair = ImagePair((luma(scene.left), luma(scene.right)))
    found = propose(pair, Sources(pair).learned, "fundamental", 0)
    y, x = np.mgrid[20:280:20, 60:340:20]
    points0 = np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)
    errors = epipolar_errors(points0, scene.match(points0), found.matrix)
    assert np.median(errors) < 0.5


def test_the_same_seed_gives_the_same_geometry(warped_pair: ImagePair) -> None:
    matches = Sources(warped_pair).learned
    for model in ("homography", "fundamental"):
        first, again = (propose(warped_pair, matches, model, 3) for _ in range(2))
        np.testing.assert_array_equal(first.matrix, again.matrix)
