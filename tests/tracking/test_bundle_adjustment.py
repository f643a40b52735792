from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pycolmap", reason="needs pycolmap")
pytest.importorskip("h5py", reason="needs h5py")

from deepdetect.tracking.bundle_adjustment import Keyframe, MapPoints, adjust_keyframes


@pytest.mark.parametrize("outliers", [0, 8])
def test_it_finds_the_exact_poses_again(drive, outliers: int) -> None:
    """The pixel convention, too: half a pixel of error would leave half a pixel."""
    made = drive(count=6)
    count = max(int(frame.tracks.max()) for frame in made.frames) + 1
    rng = np.random.default_rng(1)
    # The points of the drive, from its own exact poses.
    from deepdetect.geometry.camera import Calibration
    from deepdetect.geometry.triangulation import triangulate
    from deepdetect.tracking.tracks import common_rows

    first, last = made.frames[0], made.frames[5]
    rows0, rows1 = common_rows(first, last)
    turn = made.truth.rotations[5].T
    both = Calibration(made.camera, made.camera)
    move = -turn @ made.truth.centres[5]
    found = triangulate(first.xy[rows0], last.xy[rows1], both, turn, move)
    good = np.isfinite(found.points).all(1) & (found.triangulation_angle > 0.02)
    points = np.full((count, 3), np.nan)
    tracks = first.tracks[rows0[good]]
    points[tracks] = found.points[good]
    true = points.copy()
    keyframes = []
    for k, frame in enumerate(made.frames):
        rotation = made.truth.rotations[k].T
        translation = -rotation @ made.truth.centres[k]
        if k >= 2:
            translation = translation + rng.normal(0, 0.02, 3)
        xy = np.asarray(frame.xy, float)
        if k == 3 and outliers:
            xy = xy.copy()
            xy[:outliers] += 40
        used = np.ones(len(frame), bool)
        keyframes.append(Keyframe(k, frame.tracks, xy, used, rotation, translation))
    points[tracks] += rng.normal(0, 0.05, (len(tracks), 3))
    before = keyframes[0].centre.copy(), keyframes[1].centre.copy()
    given = MapPoints()
    given.add(np.arange(count))
    given.xyz[:] = points
    adjust_keyframes(made.camera, keyframes, given, 2, 0.5, 50)
    points = given.xyz
    np.testing.assert_array_equal(before, [keyframes[0].centre, keyframes[1].centre])
    for k, keyframe in enumerate(keyframes):
        np.testing.assert_allclose(keyframe.centre, made.truth.centres[k], atol=2e-3)
        errors = keyframe.reprojection_errors(made.camera, points[keyframe.tracks])
        assert np.median(errors[np.isfinite(errors)]) < 0.01
    assert np.median(np.linalg.norm(points[tracks] - true[tracks], axis=1)) < 0.02


def test_points_of_tracks_are_found_whatever_their_order() -> None:
    points = MapPoints()
    points.add(np.array([8, 2]))
    points.xyz[points.rows(np.array([8]))] = 4, 5, 6
    points.strikes[points.rows(np.array([2]))] = 3
    points.add(np.array([8, 5, 1]))
    assert points.tracks.tolist() == [1, 2, 5, 8]
    assert points.strikes.tolist() == [0, 3, 0, 0]
    assert points.known().tolist() == [False, False, False, True]
    assert np.isnan(points.at(np.array([7, 9]))).all(), "of tracks that were never added"
    assert points.at(np.array([2, 8]))[1].tolist() == [4, 5, 6]
    points.keep(np.array([2, 99]))
    assert points.tracks.tolist() == [2]
    assert points.strikes.tolist() == [3]
