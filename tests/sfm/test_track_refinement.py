"""Alignment of tracks on views of a textured plane, whose true positions are known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect import OptionError
from deepdetect.geometry.camera import Camera
from deepdetect.geometry.posed_view import PosedView
from deepdetect.sfm.track_refinement import (
    Observations,
    TrackRefinementOptions,
    refine_observations,
    surface_normals,
)

SIZE, DEPTH = (400, 300), 5.0


@pytest.fixture(scope="module")
def plane() -> tuple[dict[int, np.ndarray], dict[int, PosedView], np.ndarray, Observations]:
    """Views of a photograph on a plane, and where each sees some of its points."""
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    texture = cv2.GaussianBlur(cv2.cvtColor(data.astronaut(), cv2.COLOR_RGB2GRAY), (0, 0), 1)
    camera = Camera(SIZE, 400.0)
    scale = 8.0 / 512
    on_plane = np.array([[scale, 0, -4.0], [0, scale, -4.0], [0, 0, DEPTH]])
    images, views = {}, {}
    for number, (x, turn) in enumerate([(-1.0, 10.0), (0.0, 0.0), (0.9, -12.0)]):
        rotation = cv2.Rodrigues(np.radians([2.0 * number, turn, 3.0 * number]))[0].T
        views[number] = PosedView(str(number), camera, rotation, -rotation @ [x, 0.1 * number, 0])
        homography = camera.matrix @ (
            rotation @ on_plane + np.outer(views[number].translation, [0, 0, 1])
        )
        images[number] = cv2.warpPerspective(texture, homography, SIZE, flags=cv2.INTER_CUBIC)
    corners = cv2.goodFeaturesToTrack(images[1][40:260, 120:280], 60, 0.01, 8).reshape(-1, 2)
    rays = camera.rays(corners + (120, 40)) @ views[1].rotation
    points = views[1].centre + rays * (DEPTH / rays[:, 2:])
    rows = np.repeat(np.arange(len(points)), 3)
    numbers = np.tile(np.arange(3), len(points))
    xy = np.stack([views[k].project(points)[0] for k in range(3)], axis=1).reshape(-1, 2)
    inside = ((xy > 20) & (xy < np.array(SIZE) - 20)).all(axis=1)
    assert inside.mean() > 0.8
    return images, views, points, Observations(rows[inside], numbers[inside], xy[inside])


def disagreement(views, points, seen: Observations) -> np.ndarray:
    """Return how far observations are from where the plane takes those of the middle view."""
    errors = []
    for row in range(len(points)):
        own = seen.points == row
        if 1 not in seen.views[own]:
            continue
        start = seen.xy[own & (seen.views == 1)][0]
        ray = views[1].camera.rays(start[None]) @ views[1].rotation
        point = views[1].centre + ray * (DEPTH / ray[0, 2])
        for number in (0, 2):
            place = seen.xy[own & (seen.views == number)]
            if len(place):
                errors.append(np.linalg.norm(views[number].project(point)[0][0] - place[0]))
    return np.array(errors)


def test_observations_are_aligned_to_a_small_part_of_a_pixel(plane) -> None:
    images, views, points, seen = plane
    rng = np.random.default_rng(0)
    rough = Observations(seen.points, seen.views, seen.xy + rng.normal(0, 0.4, seen.xy.shape))
    places, aligned = refine_observations(images, views, points, rough)
    assert aligned.mean() > 0.9
    better = Observations(seen.points, seen.views, places)
    kept = Observations(*(values[aligned] for values in vars(better).values()))
    before, after = (np.median(disagreement(views, points, each)) for each in (rough, kept))
    assert before > 0.5
    assert after < 0.08


def test_one_observation_of_each_point_stays(plane) -> None:
    images, views, points, seen = plane
    moved = Observations(seen.points, seen.views, seen.xy + 0.3)
    places, _ = refine_observations(images, views, points, moved)
    still = np.linalg.norm(places - moved.xy, axis=1) == 0
    assert set(moved.points[still]) == set(moved.points)


def test_what_shows_something_else_is_not_aligned(plane) -> None:
    images, views, points, seen = plane
    noise = np.random.default_rng(0).integers(0, 256, images[2].shape).astype(np.uint8)
    places, aligned = refine_observations({**images, 2: noise}, views, points, seen)
    assert aligned[seen.views == 2].mean() < 0.1
    np.testing.assert_array_equal(places[~aligned], seen.xy[~aligned])


def test_flat_patches_are_not_aligned(plane) -> None:
    images, views, points, seen = plane
    flat = {number: np.full_like(image, 90) for number, image in images.items()}
    assert not refine_observations(flat, views, points, seen)[1].any()


def test_normals_face_the_cameras(plane) -> None:
    _, views, points, seen = plane
    normals = surface_normals(points, seen, views)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    np.testing.assert_allclose(normals, np.broadcast_to([0, 0, -1.0], normals.shape), atol=1e-6)


@pytest.mark.parametrize("wrong", [{"radius_px": 0}, {"neighbours": 2}, {"min_correlation": 3}])
def test_wrong_options_are_refused(wrong: dict) -> None:
    with pytest.raises(OptionError, match="must"):
        TrackRefinementOptions(**wrong)
