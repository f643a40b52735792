"""What stands still over images whose scene moves, and what only looks so."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import skimage.data

from deepdetect import PointDetector, match_images, register
from deepdetect.matching.guided import ImagePair
from deepdetect.matching.overlay import find_overlay, still_matches

WHITE = (255, 255, 255)


def bonnet(image: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Return a mask of the curved lower part of an image, which then shows a photograph."""
    height, width = image.shape[:2]
    mask = np.zeros((height, width), np.uint8)
    cv2.ellipse(mask, (width // 2, height), (width // 2, height // 4), 0, 0, 360, 1, -1)
    image[mask > 0] = cv2.resize(photo, (width, height))[mask > 0]
    return mask > 0


def caption(image: np.ndarray, photo: np.ndarray) -> np.ndarray:
    before = image.copy()
    cv2.putText(image, "12:04:31 CAM 1", (8, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.7, WHITE, 2)
    return (image != before).any(axis=2)


def logo(image: np.ndarray, photo: np.ndarray) -> np.ndarray:
    image[120:180, 170:230] = photo[60:120, 90:150]
    mask = np.zeros(image.shape[:2], bool)
    mask[120:180, 170:230] = True
    return mask


def watermark(image: np.ndarray, photo: np.ndarray) -> np.ndarray:
    text = np.zeros_like(image)
    cv2.putText(text, "SAMPLE", (110, 170), cv2.FONT_HERSHEY_SIMPLEX, 1.6, WHITE, 6)
    mask = text.any(axis=2)
    image[mask] = 0.4 * image[mask] + 0.6 * 255
    return mask


def display(image: np.ndarray, photo: np.ndarray) -> np.ndarray:
    before = image.copy()
    for x, text in ((10, "ALT 120"), (300, "SPD 33")):
        cv2.putText(image, text, (x, 280), cv2.FONT_HERSHEY_PLAIN, 1.4, (90, 255, 90), 2)
    cv2.drawMarker(image, (200, 150), (90, 255, 90), cv2.MARKER_CROSS, 40, 2)
    return (image != before).any(axis=2)


def gray(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def compressed(image: np.ndarray, quality: int = 80) -> np.ndarray:
    return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], 1)


@pytest.mark.parametrize("drawn", [bonnet, caption, logo, watermark, display])
def test_an_overlay_is_found_and_little_else(drawn, facade, photo: np.ndarray) -> None:
    scene = facade(0.3)
    views = [np.array(scene.left), np.array(scene.right)]
    masks = [drawn(view, photo) for view in views]
    found = find_overlay([gray(compressed(view)) for view in views])
    assert found[masks[0] & masks[1]].mean() > 0.6
    around = cv2.dilate(np.uint8(masks[0]), np.ones((81, 81))) > 0
    assert not (found & ~around).any()


def test_an_overlay_is_found_although_the_scene_moves_little_at_half_of_it(photo) -> None:
    # A camera drives forward: around the point it drives to, below the middle, nothing moves.
    scene = cv2.resize(skimage.data.astronaut(), (640, 480), interpolation=cv2.INTER_AREA)
    ahead = cv2.getRotationMatrix2D((320, 400), 0, 1.03)
    views = [scene, cv2.warpAffine(scene, ahead, (640, 480), flags=cv2.INTER_CUBIC)]
    assert not find_overlay([gray(compressed(view)) for view in views]).any()
    masks = [bonnet(view, photo) for view in views]
    found = find_overlay([gray(compressed(view)) for view in views])
    assert found[masks[0] & masks[1]].mean() > 0.6
    assert found[~masks[0]].mean() < 0.25  # of it, much is plain


def test_a_caption_is_found_before_unlike_grounds(photo) -> None:
    scene = cv2.resize(skimage.data.astronaut(), (900, 900), interpolation=cv2.INTER_AREA)
    views = [scene[60 * k : 60 * k + 400, 160 * k : 160 * k + 560].copy() for k in range(3)]
    masks = [caption(view, photo) for view in views]
    found = find_overlay([gray(compressed(view)) for view in views])
    assert found[masks[0] & masks[1] & masks[2]].mean() > 0.6
    assert found.mean() < 0.2


def test_a_scene_without_an_overlay_has_none(facade) -> None:
    scene = facade(0.3)
    assert not find_overlay([gray(scene.left), gray(scene.right)]).any()


def test_what_moves_before_a_still_camera_is_no_reason_to_leave_out_the_rest(
    photo: np.ndarray,
) -> None:
    background = cv2.resize(skimage.data.coffee(), (400, 300))
    views = [background.copy() for _ in range(2)]
    for view, x in zip(views, (60, 90), strict=True):
        view[80:220, x : x + 150] = photo[60:200, 40:190]
    noise = np.random.default_rng(0).normal(0, 3, (300, 400))
    views[1] = (0.7 * views[1] + noise[..., None]).clip(0, 255).astype(np.uint8)
    assert not find_overlay([gray(view) for view in views]).any()
    assert not find_overlay([gray(background), gray(background)]).any()


@pytest.mark.parametrize("baseline", [0.01, 0.03])
def test_a_small_baseline_keeps_the_far_parts(baseline: float, photo: np.ndarray) -> None:
    # The far half, ten times as far, moves by less than a pixel; the near half by some.
    focal, views = 400.0, []
    far, near = cv2.resize(skimage.data.coffee(), (440, 340)), cv2.resize(photo, (440, 340))
    for eye in (0.0, baseline):
        view = np.empty((300, 400, 3), np.uint8)
        for texture, rows, depth in ((far, slice(0, 150), 10.0), (near, slice(150, 300), 1.0)):
            move = np.float32([[1, 0, -20 - focal * eye / depth], [0, 1, -20]])
            view[rows] = cv2.warpAffine(texture, move, (400, 300), flags=cv2.INTER_CUBIC)[rows]
        views.append(view)
    found = find_overlay([gray(view) for view in views])
    assert not found.any()


@pytest.mark.parametrize("rows", [slice(150, 300), slice(60, 300)])
def test_far_parts_behind_near_ones_stay(rows: slice, photo: np.ndarray) -> None:
    # Nothing lies between what moves by 15 px and what moves by 0.3 px.
    far, near = cv2.resize(skimage.data.coffee(), (440, 340)), cv2.resize(photo, (440, 340))
    views = []
    for shift in (0, 1):
        view, front = (
            cv2.warpAffine(each, np.float32([[1, 0, -20 - move], [0, 1, -20]]), (400, 300))
            for each, move in ((far, 0.3 * shift), (near, 15 * shift))
        )
        view[rows] = front[rows]
        views.append(gray(compressed(view)))
    assert not find_overlay(views).any()


def test_a_time_stamp_and_a_display_are_found_at_night(facade, photo: np.ndarray) -> None:
    scene, noise = facade(0.3), np.random.default_rng(0)
    views = [
        (0.15 * view + noise.normal(0, 2, view.shape)).clip(0, 255).astype(np.uint8)
        for view in (scene.left, scene.right)
    ]
    for drawn in (caption, display):
        masks = [drawn(view, photo) for view in views]
    found = find_overlay([gray(compressed(view)) for view in views])
    assert found[masks[0]].mean() > 0.6
    assert found.mean() < 0.3


def test_an_overlay_over_many_images_stands_still_in_all(facade, photo: np.ndarray) -> None:
    scene = facade(0.3)
    views = [np.array(each) for each in (scene.left, scene.right, scene.left[:, ::-1])]
    masks = [caption(view, photo) for view in views]
    grays = [gray(view) for view in views]
    assert find_overlay(grays)[masks[0]].mean() > 0.5
    plain = gray(cv2.resize(skimage.data.coffee(), (400, 300)))
    assert not find_overlay([*grays, plain]).any()


def test_matches_are_of_the_scene_and_say_what_was_left_out(facade, photo: np.ndarray) -> None:
    scene = facade(0.3)
    views = [np.array(scene.left), np.array(scene.right)]
    for view in views:
        bonnet(view, photo)
    with pytest.warns(UserWarning, match="still"):
        matches = match_images(*views, PointDetector(2000))
    assert matches.success
    assert 0.1 < matches.geometry.evidence.left_out < 0.4
    moved = np.linalg.norm(matches.points1 - matches.points0, axis=1)
    assert (moved < 1).mean() < 0.01
    expected = scene.match(matches.points0)
    assert np.median(np.linalg.norm(matches.points1 - expected, axis=1)) < 1
    assert (
        match_images(scene.left, scene.right, PointDetector(2000)).geometry.evidence.left_out == 0
    )


def test_registration_follows_the_scene_below_a_still_header(photo: np.ndarray) -> None:
    page = cv2.resize(skimage.data.coffee(), (300, 400))
    views = [page[:300].copy(), page[60:360].copy()]
    for view in views:
        view[:90] = cv2.resize(photo[:64], (300, 90))
    with pytest.warns(UserWarning, match="still"):
        found = register(*views, PointDetector(2000))
    expected = np.array([[1, 0, 0], [0, 1, -60], [0, 0, 1]])
    assert np.abs(found.homography / found.homography[2, 2] - expected).max() < 0.5


@pytest.mark.slow
def test_a_caption_where_nothing_else_is_seen_to_move_is_told(shared: Path) -> None:
    views = []
    for number in (2, 6):
        view = cv2.imread(str(shared / f"data/kitti-clip/{number:06}.jpg"))[:, :, ::-1]
        view = cv2.resize(view, (828, 250), interpolation=cv2.INTER_AREA)
        for k, text in enumerate(("12:04:31 CAM 1 48 km/h", "N48.137 E11.575 2023/05/14")):
            cv2.putText(view, text, (10, 205 + 35 * k), cv2.FONT_HERSHEY_SIMPLEX, 1, WHITE, 2)
        views.append(view)
    with pytest.warns(UserWarning, match="stand"):
        matches = match_images(*views)
    assert matches.geometry is not None
    assert matches.geometry.confidence == "fair" or matches.geometry.evidence.left_out > 0.01


def test_matches_in_a_caption_before_a_plain_road_stand_still() -> None:
    scene = cv2.resize(skimage.data.astronaut(), (640, 480), interpolation=cv2.INTER_AREA)
    scene[380:] = 90
    ahead = cv2.getRotationMatrix2D((320, 240), 0, 1.05)
    views = [scene, cv2.warpAffine(scene, ahead, (640, 480), flags=cv2.INTER_CUBIC)]
    y, x = np.mgrid[10:380:6, 10:630:6]
    starts = np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)
    ends = starts @ ahead[:, :2].T + ahead[:, 2]
    plain, _ = still_matches(ImagePair((gray(views[0]), gray(views[1]))), starts, ends)
    assert not plain.any()
    for view in views:
        cv2.putText(view, "12:04:31 CAM 1", (40, 460), cv2.FONT_HERSHEY_SIMPLEX, 1, WHITE, 2)
    y, x = np.nonzero((views[0] == WHITE).all(axis=2)[440:])
    standing = np.column_stack([x, y + 440])[::5].astype(np.float64)
    pair = ImagePair((gray(compressed(views[0])), gray(compressed(views[1]))))
    both = np.concatenate([starts, standing]), np.concatenate([ends, standing])
    found, share = still_matches(pair, *both)
    assert found[len(starts) :].mean() > 0.9
    assert not found[: len(starts)].any()
    assert 0 < share < 0.1
