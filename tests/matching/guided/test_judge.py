"""Homographies that are right and wrong, of photographs, facades and strips."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import skimage.data

from deepdetect.geometry import transform_points
from deepdetect.geometry.transforms import translation_matrix
from deepdetect.io.image import load_image, luma
from deepdetect.matching.guided import ImagePair
from deepdetect.matching.guided.judge import Judge, View

from .conftest import WARP

TILT = np.array([[0.95, 0.04, 10], [-0.03, 0.97, 6], [1e-4, 5e-5, 1]])
PERIOD = 62, 70
"""Width and height of a window of the facade with the wall around it."""


def confirms(view: View) -> bool:
    """Return whether the images confirm a geometry, and reject its displaced copies."""
    return view.evidence.confirms and not view.repeated


def oxford(shared: Path, scene: str, number: int) -> np.ndarray:
    return luma(load_image(shared / "data" / "oxford" / scene / f"img{number}.png"))


@pytest.mark.parametrize(("scene", "other"), [("graf", "leuven"), ("leuven", "trees")])
def test_the_right_homography_of_two_photographs_is_confirmed_and_another_is_not(
    shared: Path, scene: str, other: str
) -> None:
    right = np.loadtxt(shared / "data" / "oxford" / scene / "H1to4p")
    first, second = oxford(shared, scene, 1), oxford(shared, scene, 4)
    judge = Judge(ImagePair((first, second)))
    view = judge.along_plane(right)
    assert confirms(view)
    assert view.evidence.share > 0.8
    assert view.evidence.agreement > 0.95
    assert not confirms(judge.along_plane(right @ translation_matrix(60, -45)))
    unrelated = Judge(ImagePair((first, oxford(shared, other, 4)))).along_plane(right)
    assert not confirms(unrelated)
    assert unrelated.evidence.share < 0.1
    assert unrelated.evidence.agreement < 0.3


def test_cells_are_explained_where_the_second_image_shows_them(warped_pair: ImagePair) -> None:
    judge = Judge(warped_pair)
    evidence = judge.along_plane(WARP).evidence
    y, x = np.mgrid[4:252:8, 4:252:8]
    points = np.column_stack([x.ravel(), y.ravel()])
    places = transform_points(points, WARP)
    clear = ((places > 12) & (places < 243)).all(axis=1)
    outside = ((places < 0) | (places > 255)).any(axis=1)
    rows, columns = judge.cells_of(points)
    assert evidence.believed[rows, columns][clear].mean() > 0.98
    assert not evidence.explained[rows, columns][outside].any()


@pytest.mark.parametrize("wrong", [False, True])
def test_matches_predict_the_place_of_what_lies_between_them(
    warped_pair: ImagePair, wrong: bool
) -> None:
    rng = np.random.default_rng(0)
    points0 = rng.uniform(0, 255, (2000, 2))
    points1 = transform_points(points0, WARP)
    if wrong:
        points1 = rng.permutation(points1)
    view = Judge(warped_pair).along_matches(points0, points1)
    assert confirms(view) != wrong
    if not wrong:
        assert view.evidence.share > 0.95


def facade(photo: np.ndarray, *, unique: bool) -> np.ndarray:
    """A wall with rows of one window; one window may be unlike the others."""
    width, height = PERIOD
    rough = np.tile(np.random.default_rng(0).normal(0, 80, (height, width)), (3, 3))
    tile = cv2.GaussianBlur(rough, (0, 0), 1.5)[height : 2 * height, width : 2 * width] + 170
    tile[12:58, 12:50] = cv2.resize(luma(photo)[60:180, 90:190], (38, 46))
    wall = np.tile(tile, (6, 7))[:360, :432]
    if unique:
        wall[140:210, 186:248] = cv2.resize(luma(photo)[30:130, 10:90], PERIOD)
    return np.clip(wall, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("unique", [False, True])
def test_a_facade_is_told_from_its_displaced_copy_by_a_window_that_is_unlike_the_others(
    photo: np.ndarray, unique: bool
) -> None:
    first = facade(photo, unique=unique)
    size = first.shape[::-1]
    second = cv2.warpPerspective(
        first, TILT, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    noise = np.random.default_rng(1).normal(0, 2, second.shape)
    second = np.clip(0.85 * second + 12 + noise, 0, 255).astype(np.uint8)
    judge = Judge(ImagePair((first, second)))
    right = judge.along_plane(TILT)
    assert right.repeated != unique
    assert confirms(right) == unique
    for shift in ((PERIOD[0], 0), (0, -PERIOD[1])):
        copy = judge.along_plane(TILT @ translation_matrix(*shift))
        assert copy.evidence.share > 0.5
        assert copy.repeated
        assert not confirms(copy)


@pytest.mark.parametrize("side", [0, 1])
def test_what_is_masked_is_not_compared(photo: np.ndarray, side: int) -> None:
    first = luma(photo)
    second = half_replaced(first)
    mask = np.zeros(first.shape, bool)
    mask[:, 128:] = True
    masks = (mask, None) if side == 0 else (None, mask)
    judge = Judge(ImagePair((first, second), masks))
    evidence = judge.along_plane(np.eye(3)).evidence
    compared = np.isfinite(evidence.similarity)
    middle = judge.cells_of(np.array([[128, 0]]))[1][0]
    assert not compared[:, middle:].any()
    assert compared[:, : middle - 6].mean() > 0.9
    assert evidence.share > 0.98
    assert evidence.agreement > 0.98


def half_replaced(image: np.ndarray) -> np.ndarray:
    other = luma(cv2.resize(skimage.data.coffee(), image.shape[::-1]))
    return np.hstack([image[:, :128], other[:, 128:]])


def test_a_half_that_was_replaced_is_contradicted_and_the_other_is_not(photo: np.ndarray) -> None:
    first = luma(photo)
    judge = Judge(ImagePair((first, half_replaced(first))))
    evidence = judge.along_plane(np.eye(3)).evidence
    middle = judge.cells_of(np.array([[128, 0]]))[1][0]
    assert not evidence.contradicted[:, : middle - 4].any()
    assert evidence.contradicted[:, middle + 4 :].mean() > 0.8
    assert evidence.share == pytest.approx(0.5, abs=0.05)
    assert evidence.agreement < 0.75


@pytest.mark.parametrize("upright", [False, True])
def test_a_strip_in_other_light_is_confirmed(upright: bool) -> None:
    """A strip that is eight times as long as wide, under a light that grows along it."""
    strip = cv2.resize(luma(skimage.data.coffee())[150:225], (640, 80))
    move = np.array([[1, 0.002, 6], [0, 1, 2], [0, 0, 1]])
    flags = {"flags": cv2.INTER_CUBIC, "borderMode": cv2.BORDER_REPLICATE}
    moved = cv2.warpPerspective(strip, move, (640, 80), **flags)
    light = np.linspace(0.3, 0.8, 640)
    moved = np.clip(moved * light + 30, 0, 255).astype(np.uint8)
    wrong = move @ translation_matrix(40, 0)
    if upright:
        exchange = np.array([[0, 1, 0], [1, 0, 0], [0, 0, 1]])
        strip, moved = strip.T.copy(), moved.T.copy()
        move, wrong = exchange @ move @ exchange, exchange @ wrong @ exchange
    judge = Judge(ImagePair((strip, moved)))
    assert confirms(judge.along_plane(move))
    assert not confirms(judge.along_plane(wrong))


def test_strips_that_move_each_by_themselves_contradict_a_homography(photo: np.ndarray) -> None:
    """It aligns one strip of eight."""
    first = luma(cv2.resize(photo, (512, 512)))
    second = first.copy()
    for k in range(8):
        strip = slice(64 * k, 64 * k + 64)
        second[:, strip] = np.roll(first, 12 * k, axis=1)[:, strip]
    evidence = Judge(ImagePair((first, second))).along_plane(np.eye(3)).evidence
    assert evidence.share < 0.3
    assert evidence.agreement < 0.5


def test_images_without_structure_give_no_evidence() -> None:
    flat = np.full((120, 160), 90, np.uint8)
    view = Judge(ImagePair((flat, flat))).along_plane(np.eye(3))
    assert not confirms(view)
    assert view.evidence.agreement == 0


def test_that_two_images_end_at_the_same_place_is_no_evidence(photo: np.ndarray) -> None:
    noise = np.random.default_rng(0).integers(0, 256, photo.shape[:2]).astype(np.uint8)
    judge = Judge(ImagePair((luma(photo), noise)))
    explained = judge.along_plane(np.eye(3)).evidence.explained
    inner = explained[6:-6, 6:-6]
    assert inner.mean() < 0.03
    assert np.count_nonzero(explained) - np.count_nonzero(inner) < 0.03 * explained.size
