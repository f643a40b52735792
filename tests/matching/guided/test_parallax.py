from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect.geometry import transfer_errors
from deepdetect.io.image import luma
from deepdetect.matching.guided import ImagePair, Sources
from deepdetect.matching.guided.parallax import Parallax, measure_parallax
from deepdetect.matching.guided.proposals import planes
from deepdetect_lab.datasets.middlebury import load_middlebury

from .conftest import WARP


@pytest.fixture(scope="module")
def cones(shared: Path) -> Parallax:
    """The parallax of a scene with depth, relative to the plane with most matches."""
    pair = load_middlebury(shared / "data" / "middlebury" / "cones")
    images = ImagePair((luma(pair.left), luma(pair.right)))
    matches = Sources(images).learned
    plane = next(planes(images, matches, 0))
    return measure_parallax(images, plane.matrix, (matches.points0, matches.points1))


def test_a_scene_with_depth_shows_it_relative_to_its_largest_plane(cones: Parallax) -> None:
    assert cones.shows_depth
    assert cones.share > 0.3


def test_the_places_lie_where_both_images_show_the_same(cones: Parallax) -> None:
    """The pair is rectified, so each place has the same row in both."""
    assert len(cones.points0) > 200
    rows = np.abs(cones.points0[:, 1] - cones.points1[:, 1])
    assert np.median(rows) < 0.25
    assert (cones.points0[:, 0] - cones.points1[:, 0] > 0).mean() > 0.95


@pytest.mark.parametrize("off_px", [0.0, 3.0])
def test_a_plane_shows_no_depth(warped_pair: ImagePair, off_px: float) -> None:
    """Nor if some tracked matches end at random places."""
    matches = Sources(warped_pair).learned
    rng = np.random.default_rng(0)
    ends = matches.points1 + rng.normal(0, off_px, matches.points1.shape)
    found = measure_parallax(warped_pair, WARP, (matches.points0, ends))
    assert not found.shows_depth
    assert np.median(transfer_errors(found.points0, found.points1, WARP)) < 0.1


def test_images_without_corners_show_no_depth() -> None:
    flat = np.full((120, 160), 90, np.uint8)
    nothing = np.empty((0, 2)), np.empty((0, 2))
    found = measure_parallax(ImagePair((flat, flat)), np.eye(3), nothing)
    assert not found.shows_depth
    assert len(found.points0) == len(found.points1) == 0
