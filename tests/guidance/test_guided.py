"""Guided matching as a whole: what it finds, and that it says so where it finds nothing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from deepdetect import DeepDetect, OptionError, match_images
from deepdetect.cli import main
from deepdetect.datasets.middlebury import load_middlebury
from deepdetect.geometry import transform_points
from deepdetect.guidance import guided_matches
from deepdetect.image import luma
from deepdetect.metrics import stereo_score

WARP = np.array([[0.9, 0.12, 20.0], [-0.1, 0.95, 18.0], [2e-4, 1e-4, 1.0]])


class Everywhere:
    """A detector that marks two pixels of three."""

    def heatmap(self, image: Any) -> np.ndarray:
        height, width = np.asarray(image).shape[:2]
        row, column = np.indices((height, width))
        return ((row + 2 * column) % 3 > 0).astype(np.float32)


@pytest.fixture(scope="module")
def second(photo: np.ndarray) -> np.ndarray:
    moved = cv2.warpPerspective(photo, WARP, (256, 256), flags=cv2.INTER_CUBIC)
    return np.clip(moved * 0.8 + 10, 0, 255).astype(np.uint8)


def test_nearly_all_points_of_a_plane_are_matched_right(
    photo: np.ndarray, second: np.ndarray
) -> None:
    matches = match_images(photo, second, Everywhere())
    assert (matches.kind, matches.guided, matches.guidance.kind) == ("homography", True) + (
        "homography",
    )
    errors = np.linalg.norm(transform_points(matches.points0, WARP) - matches.points1, axis=1)
    assert (errors < 1).mean() > 0.99
    places = transform_points(matches.keypoints0.xy, WARP)
    seen = ((places > 0) & (places < 255)).all(1)
    assert len(matches) > 0.85 * seen.sum()
    assert ((matches.ratios >= 0) & (matches.ratios < 1)).all()
    assert matches.inliers.all()
    assert len(np.unique(matches.points0, axis=0)) == len(matches)


def test_unguided_gives_fewer(photo: np.ndarray, second: np.ndarray) -> None:
    guided, unguided = (
        match_images(photo, second, Everywhere(), guidance=guidance, model="homography")
        for guidance in ("auto", "none")
    )
    assert unguided.guidance is None
    assert not unguided.guided
    assert guided.inliers.sum() > unguided.inliers.sum()


def test_what_cannot_be_trusted_is_unguided_and_says_so(photo: np.ndarray) -> None:
    data = pytest.importorskip("skimage.data")
    other = np.ascontiguousarray(data.coffee()[:256, :256])
    matches = match_images(photo, other, Everywhere(), ratio=0.9)
    assert matches.guidance.kind == "none"
    assert matches.guidance.matrix is None
    assert not matches.guided
    plain = match_images(photo, other, Everywhere(), ratio=0.9, guidance="none")
    np.testing.assert_array_equal(matches.points0, plain.points0)
    np.testing.assert_array_equal(matches.points1, plain.points1)


def test_the_command_says_what_guided(
    photo: np.ndarray, second: np.ndarray, tmp_path: Path
) -> None:
    noise = np.random.default_rng(0).integers(0, 256, photo.shape).astype(np.uint8)
    for name, image in (("a", photo), ("b", second), ("c", noise)):
        Image.fromarray(image).save(tmp_path / f"{name}.png")
    words = ["-o", str(tmp_path / "out"), "--no-pictures"]
    good = CliRunner().invoke(
        main, ["match", str(tmp_path / "a.png"), str(tmp_path / "b.png"), "--json", *words]
    )
    report = json.loads(good.stdout)
    assert report["guided"] is True
    assert report["guidance"]["kind"] == report["kind"] == "homography"
    assert report["guidance"]["sparse_inliers"] >= 10
    bad = CliRunner().invoke(
        main, ["match", str(tmp_path / "a.png"), str(tmp_path / "c.png"), *words]
    )
    assert bad.exit_code == 0
    assert "no geometry could be trusted: these matches are unguided" in bad.stderr


def test_a_scene_with_depth_is_matched_near_its_epipolar_lines(shared: Path) -> None:
    pair = load_middlebury(shared / "data" / "middlebury" / "cones")
    detector = DeepDetect("geometry")
    guided, unguided = (
        match_images(pair.left, pair.right, detector, guidance=guidance)
        for guidance in ("auto", "none")
    )
    assert guided.guided
    assert guided.kind == guided.guidance.kind == "fundamental"
    # The lines are estimated: near a corner they may be some rows off.
    assert (np.abs(guided.points0[:, 1] - guided.points1[:, 1]) <= 2).mean() > 0.98
    score = stereo_score(guided.points0, guided.points1, pair.disparity)
    plain = stereo_score(
        unguided.points0[unguided.inliers], unguided.points1[unguided.inliers], pair.disparity
    )
    assert score.right > plain.right
    assert score.share > plain.share + 0.03


def test_a_plane_that_is_asked_for_guides(shared: Path) -> None:
    pair = load_middlebury(shared / "data" / "middlebury" / "art")
    matches = match_images(pair.left, pair.right, Everywhere(), guidance="homography")
    assert matches.guidance.kind in ("homography", "none")
    by_model = match_images(pair.left, pair.right, Everywhere(), model="homography")
    assert by_model.kind == "homography"
    assert by_model.guidance.kind == matches.guidance.kind


def test_is_the_same_on_repetition(photo: np.ndarray, second: np.ndarray) -> None:
    one, other = (match_images(photo, second, Everywhere()) for _ in range(2))
    np.testing.assert_array_equal(one.points1, other.points1)
    np.testing.assert_array_equal(one.ratios, other.ratios)
    np.testing.assert_array_equal(one.model, other.model)


def test_an_unknown_guidance_brings_the_nearest(photo: np.ndarray) -> None:
    with pytest.raises(OptionError, match="did you mean 'homography'"):
        match_images(photo, photo, Everywhere(), guidance="homografy")
    with pytest.raises(OptionError, match="guidance"):
        guided_matches(luma(photo), luma(photo), np.zeros((1, 2)), np.zeros((1, 2)), "none")


def test_the_published_preset_is_unguided(photo: np.ndarray) -> None:
    matches = match_images(photo, photo, preset="published")
    assert matches.guidance is None
