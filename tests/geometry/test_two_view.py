"""A table of pairs and of what they show, by mutual matches of OpenCV's SIFT."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect.features.selection import grid_subsample
from deepdetect.geometry.camera import Calibration, Camera
from deepdetect.geometry.two_view import classify_scene
from deepdetect.io.image import load_image

TILT = np.array([[0.9, 0.12, 20.0], [-0.1, 0.95, 18.0], [4e-4, 1e-4, 1.0]])
SMALL_SIDE_PX = 480
SMALL_PARALLAX = ("rocks", "cloth", "dolls", "moebius")


def matches(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (M, 2) positions in both images, mutual and by a ratio, one for each cell."""
    sift, matcher = cv2.SIFT_create(2000), cv2.BFMatcher()
    (points0, rows0), (points1, rows1) = (
        sift.detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), None)
        for rgb in (first, second)
    )
    back = [found[0].trainIdx for found in matcher.knnMatch(rows1, rows0, k=1)]
    pairs = [
        (points0[best.queryIdx].pt, points1[best.trainIdx].pt)
        for best, next_best in matcher.knnMatch(rows0, rows1, k=2)
        if best.distance < 0.85 * next_best.distance and back[best.trainIdx] == best.queryIdx
    ]
    places = np.array(pairs).reshape(-1, 2, 2)
    places = places[grid_subsample(places[:, 0], 4)]
    return places[:, 0], places[:, 1]


def check(
    images: tuple[np.ndarray, np.ndarray], scene: str, calibration: Calibration | None = None
) -> None:
    size1 = images[1].shape[1::-1]
    assert classify_scene(*matches(*images), size1, calibration, 0)[0] == scene


def small(rgb: np.ndarray) -> np.ndarray:
    scale = SMALL_SIDE_PX / max(rgb.shape)
    return cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def warped(rgb: np.ndarray, homography: np.ndarray) -> np.ndarray:
    return cv2.warpPerspective(rgb, homography, rgb.shape[1::-1], flags=cv2.INTER_CUBIC)


@pytest.mark.parametrize("scene", ["plane", "static", "rotation", "depth", "unrelated"])
def test_photographs_of_scikit_image(scene: str) -> None:
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    coffee, astronaut = data.coffee(), data.astronaut()
    camera = Camera(coffee.shape[1::-1], 600.0)
    rotation = cv2.Rodrigues(np.radians([3, -8, 4.0]))[0]
    turn = camera.matrix @ rotation @ np.linalg.inv(camera.matrix)
    noise = np.random.default_rng(0).normal(0, 5, coffee.shape)
    pairs = {
        "plane": (coffee, warped(coffee, TILT)),
        "static": (coffee, np.clip(coffee + noise, 0, 255).astype(np.uint8)),
        "rotation": (coffee, warped(coffee, turn)),
        "depth": data.stereo_motorcycle()[:2],
        "unrelated": (astronaut, coffee),
    }
    check(pairs[scene], scene, Calibration(camera, camera) if scene == "rotation" else None)
    if scene == "rotation":  # without a calibration it cannot be told from a plane
        check(pairs[scene], "plane")


too_small = pytest.mark.xfail(
    reason="the thresholds are pixels, and the parallax of this small copy is below them",
    strict=True,
)


@pytest.mark.parametrize(
    ("folder", "names", "scene"),
    [
        *(
            pytest.param(f"middlebury/{name}", "left right", "depth", marks=too_small)
            for name in SMALL_PARALLAX
        ),
        *((f"middlebury/{name}", "left right", "depth") for name in ("art", "cones", "teddy")),
        ("oxford/graf", "img1 img2", "plane"),
        ("oxford/graf", "img1 img3", "plane"),
        ("oxford/wall", "img1 img3", "plane"),
        ("oxford/boat", "img1 img2", "plane"),
    ],
)
def test_small_copies_of_shared_pairs(shared: Path, folder: str, names: str, scene: str) -> None:
    paths = [next((shared / "data" / folder).glob(f"{name}.*")) for name in names.split()]
    check(tuple(small(load_image(path)) for path in paths), scene)


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL_PARALLAX)
def test_depth_of_shared_pairs_at_their_own_size(shared: Path, name: str) -> None:
    folder = shared / "data/middlebury" / name
    check(tuple(load_image(next(folder.glob(f"{v}.*"))) for v in ("left", "right")), "depth")


def test_a_stereo_pair_and_a_plane_are_unrelated(shared: Path) -> None:
    rocks = load_image(next((shared / "data/middlebury/rocks").glob("left.*")))
    graffiti = load_image(next((shared / "data/oxford/graf").glob("img1.*")))
    check((small(rocks), small(graffiti)), "unrelated")
