"""Frames of views with known geometry: two pinhole cameras."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.geometry.epipolar_rectification import (
    PlanarFrame,
    PolarFrame,
    RectifiedFrame,
    rectified_frame,
)

SIZE = (320, 240)
CAMERA = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])

SIDEWAYS = (np.array([0.02, -0.05, 0.03]), np.array([-1.0, 0.1, 0.05]))
FORWARD = (np.array([0.01, 0.02, -0.02]), np.array([0.05, 0.02, -1.0]))
BACKWARD = (np.array([0.0, 0.0, 0.0]), np.array([0.02, 0.0, 1.0]))
ROLLED = (np.array([0.0, 0.05, 0.6]), np.array([-1.0, 0.2, 0.0]))


def two_views(motion: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return matches of points in front of both cameras, and the fundamental matrix."""
    turn, translation = motion
    rotation = cv2.Rodrigues(turn)[0]
    points = np.random.default_rng(0).uniform((-4, -3, 6), (4, 3, 14), (400, 3))
    first, second = points @ CAMERA.T, (points @ rotation.T + translation) @ CAMERA.T
    places = first[:, :2] / first[:, 2:], second[:, :2] / second[:, 2:]
    seen = np.all([((p > 0) & (p < np.array(SIZE) - 1)).all(axis=1) for p in places], axis=0)
    x, y, z = translation
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    inverse = np.linalg.inv(CAMERA)
    return places[0][seen], places[1][seen], inverse.T @ cross @ rotation @ inverse


def plane_between(motion: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return the homography of a slanted plane in front of both cameras."""
    turn, translation = motion
    rotation = cv2.Rodrigues(turn)[0]
    normal, distance = np.array([0.1, 0.05, 1.0]), 10.0
    return CAMERA @ (rotation + np.outer(translation, normal) / distance) @ np.linalg.inv(CAMERA)


def frame_of(
    motion: tuple[np.ndarray, np.ndarray], by_plane: bool = False
) -> tuple[RectifiedFrame, list[np.ndarray]]:
    points0, points1, fundamental = two_views(motion)
    plane = plane_between(motion) if by_plane else None
    frame = rectified_frame(points0, points1, fundamental, SIZE, SIZE, plane)
    return frame, [points0, points1]


@pytest.mark.parametrize("by_plane", [False, True])
@pytest.mark.parametrize(
    ("motion", "kind"),
    [
        (SIDEWAYS, PlanarFrame),
        (ROLLED, PlanarFrame),
        (FORWARD, PolarFrame),
        (BACKWARD, PolarFrame),
    ],
    ids=["sideways", "rolled", "forward", "backward"],
)
def test_matches_lie_on_the_same_row(motion, kind, by_plane: bool) -> None:
    frame, points = frame_of(motion, by_plane)
    assert isinstance(frame, kind)
    first, second = (frame.to_frame(places, view) for view, places in enumerate(points))
    np.testing.assert_allclose(first[:, 1], second[:, 1], atol=0.01)
    width, height = frame.size
    inside = ((first > -1) & (first < (width, height))).all(axis=1)
    assert inside.mean() > 0.98  # those next to an epipole are in no frame


@pytest.mark.parametrize("by_plane", [False, True])
@pytest.mark.parametrize("motion", [SIDEWAYS, FORWARD, BACKWARD, ROLLED])
def test_there_and_back_is_the_same_place(motion, by_plane: bool) -> None:
    frame, points = frame_of(motion, by_plane)
    for view, places in enumerate(points):
        np.testing.assert_allclose(
            frame.from_frame(frame.to_frame(places, view), view), places, atol=1e-6
        )


@pytest.mark.parametrize("by_plane", [False, True])
@pytest.mark.parametrize("motion", [SIDEWAYS, FORWARD])
@pytest.mark.parametrize("view", [0, 1])
def test_a_pixel_of_the_warped_view_shows_its_place(motion, view: int, by_plane: bool) -> None:
    """The view is a ramp along x and y, so that its grey levels say where they come from."""
    frame, _ = frame_of(motion, by_plane)
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    for ramp, axis in ((x * 0.75, 0), (y * 1.0, 1)):
        image, shown = frame.warp(np.rint(ramp).astype(np.uint8), view)
        assert image.shape == shown.shape == frame.size[::-1]
        row, column = np.nonzero(cv2.erode(shown.astype(np.uint8), np.ones((7, 7))))
        chosen = np.random.default_rng(0).choice(len(row), 300, replace=False)
        pixels = np.column_stack([column[chosen], row[chosen]]).astype(float)
        places = frame.from_frame(pixels, view)
        expected = places[:, axis] * (0.75, 1.0)[axis]
        levels = image[row[chosen], column[chosen]].astype(float)
        assert np.median(np.abs(levels - expected)) < 1


def test_too_few_matches_give_no_frame() -> None:
    points0, points1, fundamental = two_views(SIDEWAYS)
    assert rectified_frame(points0[:7], points1[:7], fundamental, SIZE, SIZE) is None
