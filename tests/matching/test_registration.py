from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from tests.command_line import run_command

from deepdetect import (
    DeepDetectError,
    OptionError,
    PointDetector,
    RegistrationError,
    load_image,
    match_images,
)
from deepdetect.io.image import luma
from deepdetect.matching.registration import MAX_UNION, Registration, _union, agree, register
from deepdetect_lab.evaluation.metrics.homography import corner_error

WARP = np.array([[0.92, -0.1, 25.0], [0.08, 0.97, -6.0], [1e-4, 2e-4, 1.0]])


@pytest.fixture(scope="module")
def second(photo: np.ndarray) -> np.ndarray:
    return cv2.warpPerspective(photo, WARP, (256, 256), flags=cv2.INTER_CUBIC)


def test_the_second_image_comes_to_lie_on_the_first(photo: np.ndarray, second: np.ndarray) -> None:
    found = register(photo, second)
    assert corner_error(found.homography, WARP, (256, 256)) < 0.5
    inside = cv2.erode(found.valid.astype(np.uint8), np.ones((9, 9)), borderValue=0) > 0
    assert 0.5 < inside.mean() < 1
    assert np.abs(found.warped.astype(int) - photo)[inside].mean() < 4
    assert found.difference()[inside].mean() < 4
    assert not found.difference()[~found.valid].any()
    assert found.zncc > 0.95
    assert found.matches > 5000


def test_the_checkerboard_has_both(photo: np.ndarray) -> None:
    whole = np.ones(photo.shape[:2], bool)
    board = Registration(np.eye(3), photo, photo // 2, whole, 0, 1.0).checkerboard()
    side = 256 // 8
    np.testing.assert_array_equal(board[:side, :side], photo[:side, :side])
    brightness = board[:side, side : 2 * side].mean() / photo[:side, side : 2 * side].mean()
    assert brightness == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("one", ["thermal.tif", Path("thermal.tif"), 3])
def test_further_images_are_a_list(photo: np.ndarray, one: object) -> None:
    with pytest.raises(OptionError):
        register(photo, photo, apply_to=one)


@pytest.mark.slow
def test_images_of_different_things_are_refused(photo: np.ndarray) -> None:
    noise = np.random.default_rng(0).integers(0, 256, photo.shape).astype(np.uint8)
    with pytest.raises(DeepDetectError):
        register(photo, noise)


@pytest.mark.slow
def test_other_options_are_taken(photo: np.ndarray, second: np.ndarray) -> None:
    few = register(photo, second, PointDetector(2000), seed=3, mutual=True)
    assert 0 < few.matches <= 2000
    with pytest.raises(OptionError, match="'mutual'"):
        register(photo, second, mutal=True)


def test_the_command_writes_pictures_and_the_homography(
    photo: np.ndarray, second: np.ndarray, tmp_path: Path
) -> None:
    for name, image in (("a", photo), ("b", second)):
        Image.fromarray(image).save(tmp_path / f"{name}.png")
    words = ["register", str(tmp_path / "a.png"), str(tmp_path / "b.png"), "--json"]
    result = run_command([*words, "-o", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    for name in ("", "_checkerboard", "_difference"):
        picture = np.asarray(Image.open(tmp_path / "out" / f"b_on_a{name}.png"))
        assert picture.shape == (256, 256, 3)
    homography = np.loadtxt(tmp_path / "out" / "b_on_a_homography.txt")
    np.testing.assert_allclose(homography, report["homography"])
    assert corner_error(homography, WARP, (256, 256)) < 0.5


def poster(photo: np.ndarray) -> np.ndarray:
    """An otherwise different image, a ninth of which shows the middle of the photograph."""
    other = np.random.default_rng(0).integers(0, 256, photo.shape).astype(np.uint8)
    other[85:171, 85:171] = photo[85:171, 85:171]
    return other


def test_a_homography_that_the_images_contradict_is_refused(
    photo: np.ndarray, tmp_path: Path
) -> None:
    for name, image in (("a", photo), ("b", poster(photo))):
        Image.fromarray(image).save(tmp_path / f"{name}.png")
    assert match_images(photo, poster(photo), model="homography").success  # by what both show
    words = ["register", str(tmp_path / "a.png"), str(tmp_path / "b.png")]
    result = run_command([*words, "-o", str(tmp_path / "out")])
    assert result.exit_code == 3
    assert not (tmp_path / "out").exists()


def test_images_of_one_plane_agree_and_others_do_not(shared: Path) -> None:
    folder = shared / "data" / "oxford"
    scenes = ["graf", "leuven", "trees"]
    first, second = (
        {name: luma(load_image(folder / name / f"img{k}.png")) for name in scenes} for k in (1, 4)
    )
    for name, other in zip(scenes, [*scenes[1:], scenes[0]], strict=True):
        homography = np.loadtxt(folder / name / "H1to4p")
        assert agree(first[name], second[name], homography)
        assert not agree(first[name], second[other], homography)


@pytest.mark.parametrize("shape", [(100, 100), (100, 100, 3), (100, 100, 8)])
def test_a_union_is_limited_by_pixels_however_many_channels(shape: tuple[int, ...]) -> None:
    """The second image is shown so many times larger; both have 20,000 pixels together."""
    assert _union(shape, shape, np.diag([1 / 2, 1 / 2, 1])) == (-1, -1, 200, 200)
    assert MAX_UNION * 20_000 < 299**2
    with pytest.raises(RegistrationError):
        _union(shape, shape, np.diag([1 / 3, 1 / 3, 1]))
