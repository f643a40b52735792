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
    match_images,
)
from deepdetect.matching.registration import MAX_UNION, Registration, _union, register
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


@pytest.mark.parametrize("shape", [(100, 100), (100, 100, 3), (100, 100, 8)])
def test_a_union_is_limited_by_pixels_however_many_channels(shape: tuple[int, ...]) -> None:
    """The second image is shown so many times larger; both have 20,000 pixels together."""
    assert _union(shape, shape, np.diag([1 / 2, 1 / 2, 1])) == (-1, -1, 200, 200)
    assert MAX_UNION * 20_000 < 299**2
    with pytest.raises(RegistrationError):
        _union(shape, shape, np.diag([1 / 3, 1 / 3, 1]))


FIELDS = ("Surname", "Date of birth", "Street 12", "Town", "Account no.", "Signed")


def drawing(kind: str) -> np.ndarray:
    """A drawing with large flat parts, (480, 480) uint8."""
    page = np.full((480, 480), 255, np.uint8)
    if kind == "board":
        cv2.line(page, (120, 240), (480, 240), 0, 24)
        cv2.line(page, (120, 240), (100, 300), 0, 20)
        cv2.circle(page, (100, 300), 28, 0, -1)
        cv2.circle(page, (100, 300), 9, 255, -1)
        cv2.rectangle(page, (220, 0), (480, 40), 0, -1)
        cv2.circle(page, (290, 10), 22, 255, -1)
        cv2.rectangle(page, (340, 330), (370, 362), 0, -1)
    elif kind == "form":
        for row, word in zip((70, 125, 200, 262, 350, 401), FIELDS, strict=True):
            cv2.line(page, (40, row), (440, row), 0, 2)
            cv2.putText(page, word, (50, row - 12), 0, 0.6, 0, 2)
        cv2.rectangle(page, (40, 20), (440, 440), 0, 2)
    else:
        page[:] = 230
        coast = [[0, 200], [90, 170], [160, 260], [260, 230], [330, 330], [479, 300], [479, 479]]
        cv2.fillPoly(page, [np.array([*coast, [0, 479]])], 120)
        cv2.polylines(
            page, [np.array([[60, 479], [140, 330], [250, 300], [300, 479]])], False, 40, 3
        )
        for x, y in ((100, 300), (210, 400), (390, 390)):
            cv2.circle(page, (x, y), 7, 0, -1)
    return page


@pytest.mark.parametrize("kind", ["board", "form", "map"])
def test_flat_drawings_are_judged_by_their_structure(kind: str) -> None:
    page = drawing(kind)
    moved = np.array([[1, 0, 3.4], [0, 1, -2.6], [0, 0, 1.0]])
    shot = cv2.warpPerspective(page, moved, (480, 480), borderMode=cv2.BORDER_REPLICATE)
    shot[250:256, 200:206] = 128  # a defect
    found = register(page, shot)
    assert corner_error(found.homography, moved, (480, 480)) < 1.5


def test_a_board_whose_lines_repeat_is_registered(shared: Path) -> None:
    """A copy that is displaced by a line is as similar; most points still find their own."""
    board = shared / "cases" / "register-bare-board"
    found = register(board / "template.png", board / "test.png")
    assert corner_error(found.homography, np.eye(3), (480, 480)) < 2
    assert found.zncc > 0.9


def test_a_negative_is_registered_to_its_print(photo: np.ndarray, second: np.ndarray) -> None:
    found = register(photo, 255 - second)
    assert corner_error(found.homography, WARP, (256, 256)) < 1


@pytest.mark.parametrize("extent", ["reference", "union"])
def test_a_street_is_refused_whatever_the_frame(shared: Path, extent: str, tmp_path: Path) -> None:
    pair = [str(shared / "data" / "kitti-clip" / f"{k:06d}.jpg") for k in (0, 6)]
    if not Path(pair[0]).is_file():
        pytest.skip("needs the KITTI clip in ../shared")
    result = run_command(["register", *pair, "--extent", extent, "-o", str(tmp_path / "out")])
    assert result.exit_code == 3
    assert len(result.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()
