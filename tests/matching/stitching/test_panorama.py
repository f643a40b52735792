from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import skimage.data
from PIL import Image

from deepdetect import (
    DeepDetect,
    DeepDetectError,
    ImageError,
    OptionError,
    PointDetector,
    RegistrationError,
)
from deepdetect.geometry import transform_points
from deepdetect.matching.stitching import Panorama, StitchingOptions, stages_of, stitch
from deepdetect_lab.evaluation.metrics.homography import corner_error

HALF = StitchingOptions(scale=0.5)


@pytest.fixture(scope="module")
def panorama(views) -> Panorama:
    stages: list[str] = []
    images = [views.images[2], views.images[0], views.images[1]]
    panorama = stitch(images, progress=stages.append)
    assert stages == stages_of(3)
    return panorama


def test_the_homographies_are_known_to_a_pixel(panorama: Panorama, views) -> None:
    assert panorama.reference == 2
    true = [views.homographies[k] for k in (2, 0, 1)]
    height, width = panorama.valid.shape
    assert sorted(panorama.homographies) == [0, 1, 2]
    for number, matrix in panorama.homographies.items():
        expected = panorama.homographies[2] @ true[2] @ np.linalg.inv(true[number])
        assert corner_error(matrix, expected, (300, 280)) < 1, number
    x, y = panorama.homographies[2][:2, 2]  # the reference is moved only
    moved = [[1, 0, x], [0, 1, y], [0, 0, 1]]
    np.testing.assert_allclose(panorama.homographies[2], moved, atol=1e-9)
    corners = np.array([[0, 0], [299, 0], [299, 279], [0, 279]], float)
    ends = [transform_points(corners, true[2] @ np.linalg.inv(matrix)) for matrix in true]
    extent = np.ptp(np.concatenate(ends), axis=0) + 1
    np.testing.assert_allclose([width, height], extent, atol=2)


def test_the_panorama_is_the_photograph(panorama: Panorama, views) -> None:
    assert panorama.image.dtype == np.uint8
    assert panorama.valid.dtype == bool
    height, width = panorama.valid.shape
    assert panorama.image.shape == (height, width, 3)
    to_canvas = panorama.homographies[2] @ views.homographies[1]
    whole = cv2.warpPerspective(views.scene, to_canvas, (width, height), flags=cv2.INTER_CUBIC)
    seen = np.zeros((height, width), np.uint8)
    for number, matrix in panorama.homographies.items():
        view = np.full(views.images[number].shape[:2], 255, np.uint8)
        seen |= cv2.warpPerspective(view, matrix, (width, height), flags=cv2.INTER_NEAREST)
    assert (panorama.valid == (seen > 0)).mean() > 0.9999
    inside = cv2.erode(seen, np.ones((7, 7)), borderValue=0) > 0
    assert inside.mean() > 0.6
    assert np.abs(panorama.image.astype(int) - whole)[inside].mean() < 2
    assert not panorama.image[~panorama.valid].any()
    assert panorama.unregistered == {}
    assert set(panorama.seconds) == {"reading", "registration", "compositing"}


def test_few_points_put_it_together_without_the_network(views, monkeypatch) -> None:
    monkeypatch.setattr(DeepDetect, "_select", None)
    few = stitch([views.images[2], views.images[0], views.images[1]], PointDetector(1000))
    assert few.reference == 2
    true = [views.homographies[k] for k in (2, 0, 1)]
    for number, matrix in few.homographies.items():
        expected = few.homographies[2] @ true[2] @ np.linalg.inv(true[number])
        assert corner_error(matrix, expected, (300, 280)) < 1, number
    assert max(few.matches.values()) <= 1000


@pytest.mark.slow
def test_it_is_the_same_again_from_files_and_cropped(
    panorama: Panorama, views, tmp_path: Path
) -> None:
    paths = []
    for name in (2, 0, 1):
        paths.append(tmp_path / f"{name}.png")
        Image.fromarray(views.images[name]).save(paths[-1])
    again = stitch(paths, crop=True)
    assert again.matches == panorama.matches
    left, top = (panorama.homographies[2] - again.homographies[2])[:2, 2].round().astype(int)
    height, width = again.valid.shape
    part = (slice(top, top + height), slice(left, left + width))
    np.testing.assert_array_equal(again.image, panorama.image[part])
    assert again.valid.all()
    assert height * width > 0.5 * panorama.valid.sum()


@pytest.mark.slow
def test_reference_scale_and_unregistered(views) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (200, 200, 3)).astype(np.uint8)
    found = stitch([views.images[0], noise, views.images[1]], reference=0, options=HALF)
    assert found.reference == 0
    assert found.unregistered == {1: "it overlaps with no other image"}
    assert sorted(found.homographies) == [0, 2]
    np.testing.assert_allclose(found.homographies[0][:2, :2], np.eye(2) / 2)
    between = np.linalg.inv(found.homographies[2]) @ found.homographies[0]
    true = views.homographies[1] @ np.linalg.inv(views.homographies[0])
    assert corner_error(between, true, (300, 280)) < 1


@pytest.mark.slow
def test_registration_at_reduced_size(views) -> None:
    large = [cv2.resize(image, None, fx=2, fy=2) for image in views.images[:2]]
    found = stitch(large, options=StitchingOptions(registration_side=300))
    between = np.linalg.inv(found.homographies[1]) @ found.homographies[0]
    double = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1]])
    true = views.homographies[1] @ np.linalg.inv(views.homographies[0])
    assert corner_error(between, double @ true @ np.linalg.inv(double), (600, 560)) < 1


def test_what_makes_no_panorama_is_refused(views) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (200, 200, 3)).astype(np.uint8)
    with pytest.raises(DeepDetectError):
        stitch([views.images[0], noise])
    with pytest.raises(OptionError, match="max_canvas_megapixels"):
        stitch(views.images[:2], options=StitchingOptions(max_canvas_megapixels=0.1))
    with pytest.raises(ImageError):
        stitch([views.images[0], "missing.png"])
    with pytest.raises(OptionError):
        stitch(views.images[:1])


@pytest.mark.parametrize(
    "options",
    [
        {"reference": 2},
        {"reference": -1},
        {"reference": 0.5},
        {"projection": "cylinder"},
        {"seed": -1},
    ],
    ids=str,
)
def test_options_out_of_range_are_refused(views, options: dict) -> None:
    with pytest.raises(OptionError):
        stitch(views.images[:2], **options)


MEASURED = """
import sys
import numpy as np
from deepdetect.matching.stitching import stitch
found = stitch(sys.argv[1:])
between = np.linalg.inv(found.homographies[1]) @ found.homographies[0]
print(*between.ravel())
(peak,) = [line for line in open("/proc/self/status") if line.startswith("VmHWM")]
print(int(peak.split()[1]) * 1024)  # getrusage would begin with the memory of the parent
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")
def test_the_oxford_boat_takes_little_memory(shared: Path) -> None:
    """OpenCV's own stitcher asked for 30 GB here."""
    folder = shared / "data" / "oxford" / "boat"
    if not folder.is_dir():
        pytest.skip("needs the boat of the Oxford set in ../shared")
    words = [sys.executable, "-c", MEASURED, folder / "img1.png", folder / "img2.png"]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    matrix, peak_bytes = done.stdout.splitlines()
    between = np.array(matrix.split(), float).reshape(3, 3)
    assert corner_error(between, np.loadtxt(folder / "H1to2p"), (850, 680)) < 2
    assert int(peak_bytes) < 2.5e9


@pytest.mark.parametrize(
    "values", [{"scale": 0}, {"max_canvas_megapixels": 0}, {"registration_side": 5000}]
)
def test_sizes_out_of_range_are_refused(values: dict) -> None:
    with pytest.raises(OptionError):
        StitchingOptions(**values)


@pytest.fixture(scope="module")
def turned() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Three views of a camera with a focal length of 330 px, and the homographies to them."""
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its images")
    scene = np.ascontiguousarray(data.coffee())
    camera, seen = (np.array([[f, 0, x], [0, f, y], [0, 0, 1.0]]) for f, x, y in FOCALS)
    turns = [cv2.Rodrigues(np.radians([4.0, yaw, 2]))[0] for yaw in (-18, 0, 17)]
    homographies = [camera @ turn.T @ np.linalg.inv(seen) for turn in turns]
    return [cv2.warpPerspective(scene, h, (240, 200)) for h in homographies], homographies


FOCALS = (330, 119.5, 99.5), (400, 299.5, 199.5)


@pytest.mark.slow
@pytest.mark.parametrize("projection", ["cylindrical", "spherical"])
def test_curved_panoramas(projection, turned) -> None:
    images, true = turned
    found = stitch(images, projection=projection, crop=True)
    assert found.valid.all()
    assert found.reference == 1
    assert found.residual_px < 0.3
    width = found.image.shape[1]
    assert width == pytest.approx(330 * np.radians(18 + 17) + 220, abs=15)
    for number, matrix in found.homographies.items():
        expected = true[1] @ np.linalg.inv(true[number])
        assert corner_error(matrix, expected, (240, 200)) < 1, number


@pytest.mark.slow
def test_cameras_that_moved_make_no_curved_panorama(shared: Path) -> None:
    """The graffiti are a plane, seen from two places."""
    folder = shared / "data" / "oxford" / "graf"
    if not folder.is_dir():
        pytest.skip("needs the graffiti of the Oxford set in ../shared")
    paths = [folder / "img1.png", folder / "img2.png"]
    assert len(stitch(paths).homographies) == 2
    with pytest.raises(DeepDetectError):
        stitch(paths, projection="spherical")


TURN, RADIUS = 1800, 1800 / (2 * np.pi)


@pytest.fixture(scope="module")
def surroundings() -> np.ndarray:
    """A picture on a cylinder, (360, 1800, 3), whose ends meet: photographs with soft borders."""
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    photographs = [data.astronaut(), data.coffee(), data.chelsea(), data.rocket()]
    step, soft = TURN // len(photographs), 40
    ramp = np.minimum(np.arange(1, step + soft + 1), np.arange(step + soft, 0, -1)).clip(max=soft)
    sums, weights = np.zeros((360, TURN, 3)), np.zeros((TURN, 1))
    for k, photograph in enumerate(photographs):
        columns = (k * step + np.arange(step + soft)) % TURN
        sums[:, columns] += cv2.resize(photograph, (step + soft, 360)) * ramp[:, None]
        weights[columns] += ramp[:, None]
    return np.rint(sums / weights).astype(np.uint8)


def taken(picture: np.ndarray, rotation: np.ndarray, focal_px: float = 300.0) -> np.ndarray:
    """Photograph a picture on a cylinder, (240, 320, 3)."""
    y, x = np.mgrid[0:240, 0:320]
    rays = np.dstack([(x - 159.5) / focal_px, (y - 119.5) / focal_px, np.ones((240, 320))])
    rays = rays @ rotation.T
    column = np.arctan2(rays[..., 0], rays[..., 2]) * RADIUS % TURN
    row = rays[..., 1] / np.hypot(rays[..., 0], rays[..., 2]) * RADIUS + picture.shape[0] / 2
    picture = np.concatenate([picture, picture[:, :2]], axis=1)
    maps = column.astype(np.float32), row.astype(np.float32)
    return cv2.remap(picture, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def rotations_all_around(count: int, seed: int = 0) -> list[np.ndarray]:
    random = np.random.default_rng(seed)
    yaws = 2 * np.pi * np.arange(count) / count + random.normal(0, 0.02, count)
    tilts = [cv2.Rodrigues(np.array([*random.normal(0, 0.03, 2), 0])[[0, 2, 1]])[0] for _ in yaws]
    return [
        cv2.Rodrigues(np.array([0, yaw, 0]))[0] @ tilt
        for yaw, tilt in zip(yaws, tilts, strict=True)
    ]


@pytest.mark.parametrize(
    ("projection", "seed"), [("cylindrical", 0), ("spherical", 1), ("cylindrical", 6)]
)
def test_a_full_turn_is_closed(projection, seed, surroundings: np.ndarray) -> None:
    """Ten photographs, three of them of towers alike: what is right of the right end is at the left
    one."""
    around = rotations_all_around(10, seed)
    images = [taken(surroundings, rotation) for rotation in around]
    order = [4, 9, 0, 2, 7, 5, 1, 8, 3, 6]
    found = stitch(
        [images[k] for k in order], PointDetector(1000), projection=projection, crop=True
    )
    assert len(found.homographies) == 10
    assert found.closed
    assert found.valid.all()
    height, width = found.valid.shape
    assert width == pytest.approx(2 * np.pi * 300, abs=3)
    # Beside the join, and elsewhere, neighbouring parts are neighbours in the true picture.
    scale = width / TURN
    true = cv2.resize(np.tile(surroundings, (1, 2, 1)), None, fx=scale, fy=scale)
    for join in (width, width // 3):
        places = []
        for start in (join - 50, join):
            part = np.take(found.image, np.arange(start, start + 50) % width, axis=1)
            part = part[height // 2 - 25 : height // 2 + 25]
            scores = cv2.matchTemplate(true[:, : width + 100], part, cv2.TM_CCOEFF_NORMED)
            assert scores.max() > 0.9
            places.append(np.unravel_index(scores.argmax(), scores.shape))
        rows, columns = np.diff(places, axis=0)[0]
        assert abs((columns - 50 + 100) % width - 100) <= 1
        assert abs(rows) <= 1
    # All rotations are right, with the pair that closes the turn.
    matrix = np.array([[300, 0, 159.5], [0, 300, 119.5], [0, 0, 1.0]])
    rotations = [around[k] for k in order]
    for number, homography in found.homographies.items():
        between = rotations[found.reference].T @ rotations[number]
        expected = matrix @ between @ np.linalg.inv(matrix)
        if between[2, 2] > 0.5:  # the others are behind the reference
            assert corner_error(homography, expected, (320, 240)) < 1
    assert not found.parallax
    beside = {tuple(sorted((order.index(k), order.index((k + 1) % 10)))) for k in range(10)}
    assert beside <= set(found.matches)


def test_less_than_a_turn_is_not_cut(surroundings: np.ndarray) -> None:
    """The widest gap is behind, wherever the reference looks."""
    images = [taken(surroundings, rotation) for rotation in rotations_all_around(10)[:7]]
    found = stitch(images, PointDetector(1000), projection="cylindrical", reference=0)
    assert not found.closed
    columns = found.valid.any(axis=0)
    assert columns.all()
    assert len(columns) == pytest.approx(2 * np.pi * 300 * 6 / 10 + 300, abs=60)


def test_parallax_along_a_seam_is_told(surroundings: np.ndarray) -> None:
    """What is near moves by 6 pixels more than what is far from view to view."""
    images = []
    for k in range(3):
        rotation = cv2.Rodrigues(np.array([0, 0.5 * k, 0]))[0]
        nearer = cv2.Rodrigues(np.array([0, 0.52 * k, 0]))[0]
        image = taken(surroundings, rotation)
        image[160:] = taken(surroundings[:, ::-1], nearer)[160:]
        images.append(image)
    found = stitch(images, PointDetector(1000), projection="cylindrical")
    assert set(found.parallax) == {(0, 1), (1, 2)}
    assert all(distance == pytest.approx(6, abs=1.5) for distance in found.parallax.values())


def test_screens_with_a_small_header_make_a_page() -> None:
    page = np.ascontiguousarray(skimage.data.astronaut()[:, :300])
    screens = [page[top : top + 300].copy() for top in (0, 80, 160)]
    for screen in screens:
        screen[:60] = skimage.data.coffee()[100:160, 100:400]
    with pytest.warns(UserWarning, match="stands still"):
        found = stitch(screens, PointDetector(1000))
    assert found.image.shape[:2] == (460, 300)
    below = np.abs(found.image[70:].astype(int) - page[70:460])
    assert np.quantile(below, 0.999) < 40
    header = np.abs(found.image[:55].astype(int) - screens[0][:55])
    assert header.mean() < 4
    shifts = [found.homographies[number][1, 2] for number in range(3)]
    np.testing.assert_allclose(shifts, [0, 80, 160], atol=0.5)


def test_screens_with_a_wide_menu_make_a_page_without_a_word_on_the_camera() -> None:
    page = np.ascontiguousarray(skimage.data.astronaut()[:, :300])
    screens = []
    for top in (0, 80, 160):
        menu = cv2.resize(skimage.data.coffee(), (320, 300), interpolation=cv2.INTER_AREA)
        screens.append(np.hstack([menu, page[top : top + 300]]))
    with pytest.warns(UserWarning, match="stands still"):
        found = stitch(screens, PointDetector(1000))
    assert found.image.shape[:2] == (460, 620)
    assert np.quantile(np.abs(found.image[:, 335:].astype(int) - page[:460, 15:]), 0.999) < 40
    assert np.abs(found.image[:290, :300].astype(int) - screens[0][:290, :300]).mean() < 4
    assert not found.parallax


def test_a_logo_that_stands_still_is_drawn_only_where_nothing_else_is_seen() -> None:
    """Two of three logos lie where another image shows the scene; so does the flat part of each."""
    scene = np.ascontiguousarray(skimage.data.coffee()[:300])
    images = [scene[:, left : left + 300].copy() for left in (0, 150, 300)]
    whole = stitch(images, PointDetector(1000))
    assert whole.left_out == 0
    logo = np.full((90, 110, 3), (20, 20, 200), np.uint8)
    cv2.putText(logo, "DD", (10, 70), cv2.FONT_HERSHEY_DUPLEX, 2, (255, 255, 255), 5)
    for image in images:
        image[180:270, 20:130] = logo
    with pytest.warns(UserWarning, match="stands still"):
        found = stitch(images, PointDetector(1000))
    assert 0.11 < found.left_out < 0.25  # the logo covers 0.11
    assert found.image.shape == whole.image.shape == (300, 600, 3)
    error = np.abs(found.image.astype(int) - scene).max(axis=2)
    error[170:280, 10:140] = 0  # only the first image shows this part
    assert np.quantile(error, 0.999) < 40
    assert found.valid.all()
    np.testing.assert_allclose(found.image[230, 25], logo[50, 5], atol=12)


@pytest.mark.parametrize(("scroll", "height"), [(500, None), (300, 1200)])
def test_screens_with_header_and_menu_are_no_pile(scroll: int, height: int | None) -> None:
    """Two screens of a text page are one taller page, or refused; they do not lie on each other."""
    rng, font = np.random.default_rng(3), cv2.FONT_HERSHEY_SIMPLEX
    page = np.full((1500, 700), 255, np.uint8)
    for y in range(30, 1490, 26):
        line = "".join(rng.choice(list("abcdefghijklmnopqrstuvwxyz    "), 52))
        cv2.putText(page, line, (20, y), font, 0.55, 30, 1, cv2.LINE_AA)
    screens = []
    for top in (0, scroll):
        screen = np.full((900, 900), 220, np.uint8)
        screen[:, 200:] = page[top : top + 900]
        for k in range(20):
            entry = f"menu entry {k * 7919 % 97}"
            cv2.putText(screen, entry, (10, 170 + 34 * k), font, 0.5, 40, 1, cv2.LINE_AA)
        screen[:120] = 60
        title = "NEWS  Home  World  Sports  Login"
        cv2.putText(screen, title, (30, 70), font, 1.1, 255, 2, cv2.LINE_AA)
        screens.append(screen)
    if height is None:
        with pytest.warns(match="stands still"), pytest.raises(RegistrationError):
            stitch(screens)
        return
    with pytest.warns(UserWarning, match="stands still"):
        found = stitch(screens)
    assert found.image.shape[:2] == (height, 900)
