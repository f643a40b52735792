from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from deepdetect import DeepDetect, SelectionOptions
from deepdetect.features import select_keypoints
from deepdetect.geometry import transfer_errors
from deepdetect_lab.evaluation.baselines.method import PAPER_DESCRIPTOR, PointDescriptor
from deepdetect_lab.evaluation.unguided import PAPER_RATIO, UPRIGHT_SIFT, match_unguided

WARP = np.array([[0.99, 0.06, 4.0], [-0.05, 0.97, 12.0], [6e-5, -4e-5, 1.0]])


class Corners:
    """A stand-in for the network, with nothing but `heatmap`: how much of a corner a pixel is."""

    def heatmap(self, image: Any) -> np.ndarray:
        strength = cv2.cornerMinEigenVal(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), 3)
        return strength / (strength + np.float32(1e-3))


def warped(image: np.ndarray) -> np.ndarray:
    return cv2.warpPerspective(image, WARP, image.shape[1::-1], flags=cv2.INTER_CUBIC)


def test_the_defaults_are_what_the_published_code_runs() -> None:
    """Table of notes/published-system.md in ../shared."""
    assert astuple(PAPER_DESCRIPTOR) == ("sift", 3.0, -1.0)
    assert PAPER_RATIO == 0.99


def opencv_pipeline(
    maps: list[np.ndarray],
    images: list[np.ndarray],
    selection: SelectionOptions,
    descriptor: PointDescriptor,
    matcher: str = "flann",
    ratio: float = PAPER_RATIO,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Keypoint objects, cv2.SIFT, a FLANN or brute-force matcher and a loop over its matches."""
    keypoints, descriptors = [], []
    for heatmap, image in zip(maps, images, strict=True):
        made = [
            cv2.KeyPoint(float(x), float(y), descriptor.size_px, descriptor.angle_deg)
            for x, y in select_keypoints(heatmap, selection).xy
        ]
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        made, described = cv2.SIFT_create().compute(gray, made)
        keypoints.append(made)
        descriptors.append(described)
    cv2.setRNGSeed(0)
    if matcher == "flann":
        nearest = cv2.FlannBasedMatcher({"algorithm": 1, "trees": 5}, {"checks": 50})
    else:
        nearest = cv2.BFMatcher(cv2.NORM_L2)
    kept = [
        (best, best.distance / second.distance)
        for best, second in nearest.knnMatch(*descriptors, k=2)
        if best.distance < ratio * second.distance
    ]
    points0 = [keypoints[0][match.queryIdx].pt for match, _ in kept]
    points1 = [keypoints[1][match.trainIdx].pt for match, _ in kept]
    return np.array(points0), np.array(points1), np.array([ratio for _, ratio in kept])


@pytest.mark.parametrize(
    ("selection", "descriptor", "options"),
    [
        ({"density": 0.02}, UPRIGHT_SIFT, {"ratio": 0.8}),
        ({"threshold": 0.8}, PAPER_DESCRIPTOR, {"ratio": 0.9}),
        ({"max_keypoints": 300}, PointDescriptor(size_px=5.0), {"matcher": "exact"}),
        (
            {"nms_radius": 2},
            PointDescriptor(angle_deg=30.0),
            {"ratio": 0.7, "matcher": "exact"},
        ),
    ],
)
def test_equals_a_pipeline_of_opencv(
    photo: np.ndarray,
    selection: dict[str, Any],
    descriptor: PointDescriptor,
    options: dict[str, Any],
) -> None:
    part = photo[50:200, 60:230]
    images = [part, warped(part)]
    corners, chosen = Corners(), SelectionOptions(**selection)
    matches = match_unguided(*images, corners, selection=chosen, descriptor=descriptor, **options)
    maps = [corners.heatmap(image) for image in images]
    points0, points1, ratios = opencv_pipeline(maps, images, chosen, descriptor, **options)
    assert len(matches) > 20
    np.testing.assert_array_equal(matches.points0, points0)
    np.testing.assert_array_equal(matches.points1, points1)
    np.testing.assert_allclose(matches.scores, 1 - ratios, atol=1e-5)
    assert matches.geometry is None


@pytest.mark.parametrize("constant", [(True, True), (True, False), (False, True)])
def test_a_constant_image_has_no_matches(photo: np.ndarray, constant: tuple[bool, bool]) -> None:
    flat = np.full((48, 64, 3), 200, np.uint8)
    images = [flat if is_flat else photo[:64, :64] for is_flat in constant]
    assert len(match_unguided(*images, Corners())) == 0


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "correct"), [("leuven", 58_946), ("ubc", 39_891)])
def test_the_published_system_is_reproduced(
    shared: Path, published: Callable[[str], Path], scene: str, correct: int
) -> None:
    """Correct matches of images 1 and 6 as measured with the authors' own code."""
    folder = shared / "data" / "oxford" / scene
    detector = DeepDetect(published("matching"), resolution=480, network_channels="bgr")
    matches = match_unguided(folder / "img1.png", folder / "img6.png", detector)
    errors = transfer_errors(matches.points0, matches.points1, np.loadtxt(folder / "H1to6p"))
    assert np.count_nonzero(errors < 1) == pytest.approx(correct, rel=0.03)
