from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from deepdetect.evaluation.baselines import CLASSICAL
from deepdetect.evaluation.baselines.method import describe_with
from deepdetect.features.keypoints import Keypoints
from deepdetect.io.image import luma

HOME = cv2 if hasattr(cv2, "BRISK_create") else cv2.xfeatures2d


@pytest.fixture(scope="module")
def crop(photo: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(photo[60:180, 60:200])


def grid(size: tuple[int, int], step: int) -> np.ndarray:
    """Points from corner to corner, by columns, so that no descriptor's own order is theirs."""
    columns, rows = np.meshgrid(np.arange(0, size[0], step), np.arange(0, size[1], step))
    return np.column_stack([columns.ravel(order="F"), rows.ravel(order="F")])


@pytest.mark.parametrize("name", ["orb", "brisk", "sift"])
def test_each_keypoint_keeps_its_row_also_near_the_border(crop: np.ndarray, name: str) -> None:
    make = {"orb": cv2.ORB_create, "brisk": HOME.BRISK_create, "sift": cv2.SIFT_create}[name]
    xy = grid((140, 120), 9)
    octaves = (np.arange(len(xy)) % 3).astype(np.int32) if name == "orb" else None
    sizes = np.full(len(xy), 12, np.float32)
    angles = (np.arange(len(xy)) * 7 % 360).astype(np.float32)
    features = Keypoints(xy, np.ones(len(xy)), (140, 120), sizes, angles, octaves)
    rows = describe_with(make, crop, features)
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


def test_orb_leaves_out_31_pixels_at_each_border(crop: np.ndarray) -> None:
    xy = grid((140, 120), 1)
    features = Keypoints(xy, np.ones(len(xy)), (140, 120))
    described = describe_with(cv2.ORB_create, crop, features).any(1)
    inside = ((xy >= 31) & (xy < (140 - 31, 120 - 31))).all(1)
    np.testing.assert_array_equal(described, inside)


@pytest.mark.parametrize(
    ("make", "columns", "dtype"),
    [
        (cv2.SIFT_create, 128, np.float32),
        (cv2.ORB_create, 32, np.uint8),
        (HOME.BRISK_create, 64, np.uint8),
    ],
)
def test_no_keypoints_have_no_descriptors(crop: np.ndarray, make, columns: int, dtype) -> None:
    rows = describe_with(make, crop, Keypoints(np.empty((0, 2)), np.empty(0), (140, 120)))
    assert (rows.shape, rows.dtype) == ((0, columns), dtype)


@pytest.mark.parametrize("make", [cv2.ORB_create, HOME.BRISK_create])
def test_keypoints_at_the_border_only_get_zeros(crop: np.ndarray, make) -> None:
    rows = describe_with(make, crop, Keypoints([[0, 0], [139, 119]], [1, 1], (140, 120)))
    assert rows.shape[0] == 2
    assert not rows.any()


def test_what_keypoints_depend_on_is_the_name_and_the_version_unless_they_are_shared() -> None:
    method = CLASSICAL["fast"]
    assert method.detection == "fast 1"
    newer = dataclasses.replace(method, detection="", version="2")
    assert newer.detection == "fast 2"
    other = dataclasses.replace(method, name="fast-common", version="1 rootsift")
    assert other.detection == "fast 1"
