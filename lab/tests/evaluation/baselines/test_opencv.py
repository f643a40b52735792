"""Each classical method beside OpenCV itself, called with the settings that are written down."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from deepdetect.features.keypoints import Keypoints
from deepdetect.io.image import luma
from deepdetect_lab.evaluation.baselines.opencv import CLASSICAL, STANDARD, describe_with

HOME = cv2 if hasattr(cv2, "BRISK_create") else cv2.xfeatures2d


def low_orb() -> cv2.ORB:
    orb = cv2.ORB_create()
    orb.setMaxFeatures(1_000_000)
    orb.setFastThreshold(1)
    return orb


def low_agast() -> cv2.Feature2D:
    agast = HOME.AgastFeatureDetector_create()
    agast.setThreshold(1)
    agast.setNonmaxSuppression(False)
    agast.setType(HOME.AgastFeatureDetector_AGAST_7_12d)
    return agast


def low_fast() -> cv2.FastFeatureDetector:
    fast = cv2.FastFeatureDetector_create()
    fast.setThreshold(1)
    fast.setNonmaxSuppression(False)
    return fast


# SIFT: number, layers, contrast, edge, sigma.  BRISK: threshold, octaves.
DETECTORS: dict[str, Callable[[], cv2.Feature2D]] = {
    "sift": cv2.SIFT_create,
    "sift-low": lambda: cv2.SIFT_create(0, 4, 1e-9, 100, 0.7),
    "orb": cv2.ORB_create,
    "orb-low": low_orb,
    "brisk": lambda: HOME.BRISK_create(),
    "brisk-low": lambda: HOME.BRISK_create(1, 4),
    "fast": cv2.FastFeatureDetector_create,
    "fast-low": low_fast,
    "agast": lambda: HOME.AgastFeatureDetector_create(),
    "agast-low": low_agast,
}


@pytest.fixture(scope="module")
def crop(photo: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(photo[20:170, 60:220])


@pytest.mark.parametrize("name", DETECTORS)
def test_keypoints_equal_those_of_opencv(crop: np.ndarray, name: str) -> None:
    expected = DETECTORS[name]().detect(luma(crop), None)
    found = CLASSICAL[name].detect(crop)
    assert found.image_size == (160, 150)
    assert len(found) == len(expected) > 50
    np.testing.assert_array_equal(found.xy, np.array([p.pt for p in expected], np.float32))
    for column, field in (
        (found.scores, "response"),
        (found.sizes, "size"),
        (found.angles, "angle"),
        (found.octaves, "octave"),
    ):
        np.testing.assert_array_equal(column, [getattr(p, field) for p in expected])


@pytest.mark.parametrize("name", ["sift", "orb", "brisk"])
def test_own_descriptors_equal_those_of_one_call(crop: np.ndarray, name: str) -> None:
    points, expected = DETECTORS[name]().detectAndCompute(luma(crop), None)
    found = CLASSICAL[name].detect(crop)
    described = CLASSICAL[name].describe(crop, found)
    assert described.dtype == expected.dtype
    np.testing.assert_array_equal(found.xy, np.array([p.pt for p in points], np.float32))
    np.testing.assert_array_equal(described, expected)


def test_sift_finds_spots_where_they_are() -> None:
    """OpenCV's default finds them a quarter of a pixel to the right and below."""
    y, x = np.indices((160, 160))
    centres = np.random.default_rng(0).uniform(-0.5, 0.5, (16, 2)) + np.array(
        [(20 + 40 * k, 20 + 40 * j) for k in range(4) for j in range(4)]
    )
    light = sum(np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * 2.5**2)) for cx, cy in centres)
    rgb = np.repeat(np.rint(30 + 180 * light).astype(np.uint8)[..., None], 3, axis=2)
    found = STANDARD["sift"].detect(rgb).xy
    offsets = found[:, None] - centres
    nearest = offsets[np.linalg.norm(offsets, axis=2).argmin(axis=0), np.arange(16)]
    assert np.abs(nearest).max() < 0.2
    assert np.abs(nearest.mean(axis=0)).max() < 0.05


@pytest.mark.parametrize("name", ["fast", "agast-low", "sift-low"])
def test_the_others_get_sift_descriptors(crop: np.ndarray, name: str) -> None:
    crop = np.ascontiguousarray(crop[:70, :70])
    points = DETECTORS[name]().detect(luma(crop), None)
    points, expected = cv2.SIFT_create().compute(luma(crop), points)
    described = CLASSICAL[name].describe(crop, CLASSICAL[name].detect(crop))
    assert len(points) == len(described)
    np.testing.assert_array_equal(described, expected)


@pytest.mark.parametrize(
    ("name", "block", "aperture", "k", "share"),
    [("harris", 2, 3, 0.04, 0.04), ("harris-low", 3, 5, 0.001, 0.001)],
)
def test_harris_points_are_the_pixels_over_a_share_of_the_largest(
    crop: np.ndarray, name: str, block: int, aperture: int, k: float, share: float
) -> None:
    response = cv2.cornerHarris(np.float32(luma(crop)), block, aperture, k)
    widened = cv2.dilate(response, np.ones((3, 3), np.uint8))
    found = CLASSICAL[name].detect(crop)
    mask = np.zeros(widened.shape, bool)
    column, row = found.xy.astype(int).T
    mask[row, column] = True
    # A pixel may fall to either side where it equals the limit but for rounding.
    limit = share * widened.max()
    clear = np.abs(widened - limit) > 1e-4 * limit
    assert len(found) == np.count_nonzero(mask)
    np.testing.assert_array_equal(mask[clear], (widened > limit)[clear])
    # The scale is that of 8-bit luma, and plays no part.
    np.testing.assert_allclose(
        found.scores / found.scores.max(), widened[row, column] / widened.max(), rtol=1e-3
    )


@pytest.mark.parametrize(
    ("name", "quality", "k"), [("shi-tomasi", 0.01, 0.04), ("shi-tomasi-low", 1e-6, 0.001)]
)
def test_shi_tomasi_corners_equal_those_of_opencv(
    crop: np.ndarray, name: str, quality: float, k: float
) -> None:
    expected = cv2.goodFeaturesToTrack(
        luma(crop), 1_000_000, quality, 1, useHarrisDetector=True, k=k
    )
    found = CLASSICAL[name].detect(crop)
    np.testing.assert_array_equal(found.xy, expected.reshape(-1, 2))
    # They come with the best first; the score is the one that the limit applies to.
    assert (np.diff(found.scores) <= 0).all()
    assert found.scores[-1] > 0.99 * quality * found.scores[0]


@pytest.mark.parametrize("name", ["sift", "orb-low", "harris-low", "shi-tomasi"])
def test_a_picture_of_one_colour_has_no_keypoints(name: str) -> None:
    flat = np.full((70, 80, 3), 128, np.uint8)
    found = CLASSICAL[name].detect(flat)
    assert len(found) == 0
    described = CLASSICAL[name].describe(flat, found)
    assert described.shape[0] == 0
    assert described.ndim == 2


def grid(size: tuple[int, int], step: int) -> np.ndarray:
    """Points from corner to corner, by columns, so that no descriptor's own order is theirs."""
    columns, rows = np.meshgrid(np.arange(0, size[0], step), np.arange(0, size[1], step))
    return np.column_stack([columns.ravel(order="F"), rows.ravel(order="F")])


@pytest.mark.parametrize("name", ["orb", "brisk", "sift"])
def test_each_keypoint_keeps_its_row_also_near_the_border(crop: np.ndarray, name: str) -> None:
    make = {"orb": cv2.ORB_create, "brisk": HOME.BRISK_create, "sift": cv2.SIFT_create}[name]
    xy = grid((160, 150), 9)
    octaves = (np.arange(len(xy)) % 3).astype(np.int32) if name == "orb" else None
    sizes = np.full(len(xy), 12, np.float32)
    angles = (np.arange(len(xy)) * 7 % 360).astype(np.float32)
    features = Keypoints(xy, np.ones(len(xy)), (160, 150), None, sizes, angles, octaves)
    rows = describe_with(make(), crop, features)
    assert len(rows) == len(features)
    kept, opened = 0, make()
    for row, keypoint in zip(rows, features.to_opencv(), strict=True):
        _, alone = opened.compute(luma(crop), [keypoint])
        if alone is None or not len(alone):
            assert not row.any()
        else:
            kept += 1
            np.testing.assert_array_equal(row, alone[0])
    assert kept == len(xy) if name == "sift" else 0 < kept < len(xy)
