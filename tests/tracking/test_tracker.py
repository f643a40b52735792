from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect import Keypoints, OptionError
from deepdetect.io.image import luma
from deepdetect.tracking import Tracker, TrackingOptions, point_candidates
from deepdetect.tracking.tracker import free_keypoints


def grid_keypoints(rgb: np.ndarray) -> Keypoints:
    """Every twelfth pixel of a grid: where they are does not depend on the image."""
    height, width = rgb.shape[:2]
    xy = np.stack(np.meshgrid(range(20, width - 20, 12), range(20, height - 20, 12)), -1)
    xy = xy.reshape(-1, 2)
    return Keypoints(xy, np.linspace(1, 0.5, len(xy)), (width, height))


def test_tracks_move_as_the_photograph_does(moving_photo) -> None:
    """Known answer: the camera moves by (3, 2) pixels, so every point moves by (-3, -2)."""
    tracker = Tracker(grid_keypoints, TrackingOptions(detect_every=99, min_kept=0))
    frames = [tracker.update(moving_photo(k)) for k in range(6)]
    first, last = frames[0], frames[-1]
    assert len(last) > 0.8 * len(first)
    rows = np.searchsorted(first.tracks, last.tracks)
    errors = np.linalg.norm(last.xy - first.xy[rows] - 5 * np.array([-3, -2]), axis=1)
    assert np.median(errors) < 0.05
    assert np.percentile(errors, 95) < 0.3
    assert (last.ages == 5).all()
    np.testing.assert_array_equal(last.scores, first.scores[rows])


@pytest.mark.parametrize("kind", ["nearer", "turn"])
def test_errors_do_not_add_up(photo, kind) -> None:
    """Known answer: the camera turns by 1.5 degrees or comes nearer by 2 % a frame, with noise."""
    rng, size = np.random.default_rng(0), photo.shape[1]
    middle = (size - 1) / 2, (size - 1) / 2
    tracker = Tracker(grid_keypoints, TrackingOptions(detect_every=99, min_kept=0))
    frames = []
    for k in range(21):
        angle, scale = (1.5 * k, 1) if kind == "turn" else (0, 1.02**k)
        motion = cv2.getRotationMatrix2D(middle, angle, scale)
        seen = cv2.warpAffine(photo, motion, (size, size), flags=cv2.INTER_CUBIC)
        seen = np.clip(seen + rng.normal(0, 3, seen.shape), 0, 255).round().astype(np.uint8)
        frames.append(tracker.update(seen))
    first, last = frames[0], frames[-1]
    true = cv2.transform(first.xy[last.tracks][None], motion)[0]
    errors = np.linalg.norm(last.xy - true, axis=1)
    assert len(last) > 0.3 * len(first)
    assert np.median(errors) < 0.25  # only followed from frame to frame: 2.2


def test_points_that_come_from_the_border_are_not_moved_off(moving_photo) -> None:
    """Known answer: two pixels a frame. Their first patches would reach over the border."""
    frames = [moving_photo(k, (-2, 0)) for k in range(-60, -56)]
    near = np.zeros((240, 320), np.uint8)
    near[15:-15, 3:9] = 1
    corners = cv2.goodFeaturesToTrack(luma(frames[0]), 100, 0.01, 8, mask=near).reshape(-1, 2)
    found = Keypoints(corners, np.ones(len(corners)), (320, 240))
    tracker = Tracker(lambda rgb: found, TrackingOptions(detect_every=99, min_kept=0))
    first, *_, last = [tracker.update(frame) for frame in frames]
    assert len(last) > 5
    np.testing.assert_allclose(last.xy, first.xy[last.tracks] + (6, 0), atol=0.01)


def test_positions_agree_with_another_implementation(moving_photo) -> None:
    """Template matching of whole patches finds the same places."""
    tracker = Tracker(grid_keypoints, TrackingOptions(detect_every=99, min_kept=0))
    first, second = tracker.update(moving_photo(0)), tracker.update(moving_photo(1))
    images = luma(moving_photo(0)), luma(moving_photo(1))
    rows = np.searchsorted(first.tracks, second.tracks)
    for place, found in list(zip(first.xy[rows], second.xy, strict=True))[::25]:
        x, y = np.rint(place).astype(int)
        patch = images[0][y - 10 : y + 11, x - 10 : x + 11]
        scores = cv2.matchTemplate(images[1], patch, cv2.TM_CCOEFF_NORMED)
        row, column = np.unravel_index(scores.argmax(), scores.shape)
        np.testing.assert_allclose(found, (column + 10, row + 10), atol=0.6)


def test_new_points_only_where_there_are_no_tracks(moving_photo) -> None:
    options = TrackingOptions(detect_every=1, max_keypoints=300)
    tracker = Tracker(grid_keypoints, options)
    tracker.update(moving_photo(0))
    for k in range(1, 4):
        frame = tracker.update(moving_photo(k))
        assert len(frame) <= 300
        assert len(set(frame.tracks.tolist())) == len(frame)
        new = frame.xy[frame.ages == 0]
        old = frame.xy[frame.ages > 0]
        if len(new):
            gaps = np.linalg.norm(new[:, None] - old, axis=2).min(axis=1)
            assert gaps.min() > 8 - 1.5  # of the nearest pixels


def test_few_points_are_all_over_the_image(moving_photo) -> None:
    tracker = Tracker(grid_keypoints, TrackingOptions(max_keypoints=20))
    xy = tracker.update(moving_photo(0)).xy
    gaps = np.linalg.norm(xy[:, None] - xy, axis=2) + 99 * np.eye(len(xy))
    assert len(xy) == 20
    assert gaps.min() > 0.3 * (320 * 240 / 20) ** 0.5


def test_changes_of_a_frame_do_not_move_the_tracks(moving_photo) -> None:
    trackers = Tracker(grid_keypoints), Tracker(grid_keypoints)
    for tracker in trackers:
        tracker.update(moving_photo(0)).xy[:] *= 0.5 if tracker is trackers[0] else 1
    first, second = (tracker.update(moving_photo(1)) for tracker in trackers)
    np.testing.assert_array_equal(first.xy, second.xy)


def test_a_point_that_is_covered_is_lost(moving_photo) -> None:
    tracker = Tracker(grid_keypoints, TrackingOptions(detect_every=99, min_kept=0))
    tracker.update(moving_photo(0))
    covered = moving_photo(1).copy()
    covered[:, :160] = np.random.default_rng(0).integers(0, 256, (240, 160, 3))
    found = tracker.update(covered)
    assert np.count_nonzero(found.xy[:, 0] < 140) < 0.05 * np.count_nonzero(found.xy[:, 0] > 180)


def test_a_frame_without_corners_is_no_error() -> None:
    """Its equations cannot be solved without what is added to them."""
    ramp = np.add.outer(range(96), range(128)).astype(np.uint8)
    tracker = Tracker(grid_keypoints)
    for _ in range(3):
        frame = tracker.update(ramp)
    assert np.isfinite(frame.xy).all()


def test_a_black_frame_loses_all_points_of_deepdetect_and_is_no_error(moving_photo) -> None:
    options = TrackingOptions(max_keypoints=200)
    tracker = Tracker(point_candidates(options), options)
    first, second = (tracker.update(moving_photo(k)) for k in range(2))
    assert 100 < len(first) <= 200
    assert np.isin(second.tracks, first.tracks).mean() > 0.8
    assert len(tracker.update(np.zeros((240, 320, 3), np.uint8))) == 0
    again = tracker.update(moving_photo(2))
    assert len(again)
    assert (again.ages == 0).all()


def test_frames_of_two_sizes_are_refused(moving_photo) -> None:
    tracker = Tracker(grid_keypoints)
    tracker.update(moving_photo(0))
    with pytest.raises(OptionError, match="320x200"):
        tracker.update(moving_photo(0)[:200])


def test_free_keypoints_takes_the_best_first() -> None:
    points = Keypoints([[5, 5], [7, 5], [30, 5], [50, 5]], [0.1, 0.9, 0.5, 0.7], (60, 10))
    assert free_keypoints(points, np.empty((0, 2)), 5, 2).tolist() == [1, 3]
    assert free_keypoints(points, np.array([[51, 6]]), 5, 9).tolist() == [1, 2]


@pytest.mark.parametrize(("name", "value"), [("max_keypoints", 1.5), ("min_kept", 1.1)])
def test_wrong_options(name: str, value: float) -> None:
    with pytest.raises(OptionError, match=name):
        TrackingOptions(**{name: value})


@pytest.mark.parametrize(("start", "shift"), [(0.0, 0.25), (0.25, 0.5), (0.25, 2.3)])
def test_positions_between_pixels_are_right(waves, start: float, shift: float) -> None:
    """Known answer: an image that is a sum of waves, moved by a fraction of a pixel."""
    grid = np.stack(np.meshgrid(range(30, 290, 12), range(30, 290, 12)), -1).reshape(-1, 2) + start
    points = Keypoints(grid, np.linspace(1, 0.5, len(grid)), (320, 320))
    tracker = Tracker(lambda rgb: points, TrackingOptions(detect_every=99, min_kept=0))
    first, second = (np.repeat(waves(k * shift, -k * shift)[..., None], 3, 2) for k in range(2))
    tracker.update(first)
    found = tracker.update(second)
    true = grid[found.tracks] + (shift, -shift)
    assert len(found) > 0.7 * len(grid)
    assert np.median(np.linalg.norm(found.xy - true, axis=1)) < 0.02
