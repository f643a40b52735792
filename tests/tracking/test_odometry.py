from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pycolmap", reason="needs pycolmap")
pytest.importorskip("h5py", reason="needs h5py")

from deepdetect import OptionError
from deepdetect.evaluation.metrics.trajectory import trajectory_errors
from deepdetect.tracking import OdometryOptions, VisualOdometry


def errors_of(odometry: VisualOdometry, truth):
    found = odometry.trajectory()
    true = truth.at(found.frames)
    return trajectory_errors(found.rotations, found.centres, true.rotations, true.centres)


def run(drive, **options) -> VisualOdometry:
    odometry = VisualOdometry(drive.camera, OdometryOptions(**options))
    for frame in drive.frames:
        odometry.update(frame)
    return odometry


def test_exact_tracks_give_the_path(drive) -> None:
    made = drive()
    odometry = run(made)
    assert odometry.lost is None
    np.testing.assert_array_equal(odometry.trajectory().frames, np.arange(25))
    errors = errors_of(odometry, made.truth)
    assert errors.end_percent < 0.01
    assert errors.end_deg_per_m < 1e-4


def test_noise_and_things_that_move(drive) -> None:
    made = drive(noise_px=0.3, moving=200)
    odometry = run(made)
    assert len(odometry.trajectory()) == 25
    errors = errors_of(odometry, made.truth)
    assert errors.end_percent < 1.5
    assert errors.end_deg_per_m < 0.01
    # What moves is not in the map: all its points lie where static ones were drawn.
    assert len(odometry.points) > 200


def test_frames_between_keyframes_have_poses(drive) -> None:
    made = drive(noise_px=0.2)
    every, few = run(made), run(made, min_motion_px=30, min_tracked=0.3)
    assert len(few._keyframes) < len(every._keyframes)
    assert len(few.trajectory()) == 25
    assert errors_of(few, made.truth).end_percent < 2


def test_what_is_kept_does_not_grow_with_the_path(drive, monkeypatch) -> None:
    """Of old keyframes their poses; and that changes no pose."""
    made = drive(count=40, noise_px=0.3, moving=100)
    near = {"window": 4, "anchors": 3}
    odometry = run(made, **near)
    lengths = [len(keyframe.tracks) for keyframe in odometry._keyframes]
    assert len(lengths) > 30
    assert min(lengths[-7:]) > 100
    assert set(lengths[:-7]) == {0}
    seen = [keyframe.tracks for keyframe in odometry._keyframes] + [made.frames[-1].tracks]
    assert odometry._map.tracks.tolist() == np.unique(np.concatenate(seen)).tolist()
    monkeypatch.setattr(VisualOdometry, "_forget", lambda *_: None)
    whole = run(made, **near)
    assert min(len(keyframe.tracks) for keyframe in whole._keyframes) > 100
    assert len(whole._map.tracks) > 2 * len(odometry._map.tracks)
    np.testing.assert_array_equal(odometry.points, whole.points)
    np.testing.assert_array_equal(odometry.trajectory().centres, whole.trajectory().centres)


def test_a_camera_that_stands_for_long_is_waited_for(drive) -> None:
    made = drive(count=40, standing=25, noise_px=0.1)
    odometry = VisualOdometry(made.camera, OdometryOptions(max_waiting=8))
    waiting = 0
    for frame in made.frames:
        odometry.update(frame)
        waiting = max(waiting, len(odometry._waiting))
    assert waiting == 8
    found = odometry.trajectory()
    assert found.frames[0] == 0
    assert found.frames[1] >= 18, "of those between there are no poses"
    np.testing.assert_array_equal(found.frames[1:], np.arange(found.frames[1], 40))
    assert errors_of(odometry, made.truth).end_percent < 1.5


def test_a_camera_that_stands_gets_poses_when_it_moves(drive) -> None:
    made = drive(count=20, standing=5, noise_px=0.1)
    odometry = VisualOdometry(made.camera)
    known = [odometry.update(frame) for frame in made.frames]
    assert not any(known[:5])
    assert all(known[8:])
    assert errors_of(odometry, made.truth).end_percent < 1.5


def test_a_rotation_alone_gives_no_path(drive) -> None:
    made = drive(count=10, standing=99)
    odometry = run(made, min_first_motion_px=5)
    assert len(odometry.trajectory()) == 0


def test_it_says_where_it_was_lost(drive) -> None:
    from deepdetect.tracking import TrackedFrame

    made = drive()
    nothing = TrackedFrame(
        12, np.empty(0, np.int64), np.empty((0, 2)), np.empty(0), np.empty(0, np.int64)
    )
    odometry = VisualOdometry(made.camera)
    for frame in [*made.frames[:12], nothing]:
        found = odometry.update(frame)
    assert not found
    assert odometry.lost == 12
    assert not odometry.update(made.frames[13])
    assert len(odometry.trajectory()) == 12


def test_the_same_tracks_give_the_same_path(drive) -> None:
    import cv2

    made = drive(noise_px=0.3, moving=200)
    paths = []
    for seed in (1, 2):  # of the caller's own work
        cv2.setRNGSeed(seed)
        paths.append(run(made).trajectory().centres)
    np.testing.assert_allclose(*paths, rtol=1e-9)


@pytest.mark.parametrize(
    "values",
    [
        {"window": 1},
        {"min_inliers": 3},
        {"max_error_px": 0},
        {"min_tracked": 2},
        {"max_waiting": 1},
    ],
)
def test_wrong_options(values) -> None:
    with pytest.raises(OptionError, match=next(iter(values))):
        OdometryOptions(**values)
