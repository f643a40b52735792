"""Dense points with synthetic cameras, whose points are known; the pipeline tests the matching."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepdetect.geometry.camera import Camera, PosedView
from deepdetect.io.image_file import read_with, reading_options
from deepdetect.sfm import dense
from deepdetect.sfm.colmap import CameraIntrinsics
from deepdetect.sfm.dense import (
    DENSE_POINT,
    find_references,
    fuse_matches,
    limited_view,
    merge_dense_points,
)
from deepdetect.sfm.mapping import RegisteredImage, SparseModel

SIZE = (320, 240)


def view(x: float, name: str = "") -> PosedView:
    """Return a camera at (x, 0, 0) that looks at (0, 0, 6)."""
    angle = np.arctan2(x, 6)
    rotation = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    return PosedView(name, Camera(SIZE, 300.0), rotation, -rotation @ [x, 0, 0])


@pytest.fixture
def scene() -> tuple[PosedView, list[PosedView], np.ndarray, np.ndarray]:
    """A reference, four neighbours, pixels of the reference and the points that they show."""
    rng = np.random.default_rng(0)
    xy = rng.uniform((20, 20), (300, 220), (500, 2))
    reference = view(0)
    points = reference.camera.rays(xy) * rng.uniform(5, 7, (500, 1))
    return reference, [view(x) for x in (-1.0, -0.5, 0.5, 1.0)], xy, points


def test_exact_matches_give_the_points(scene) -> None:
    reference, others, xy, points = scene
    matches = [other.project(points)[0] for other in others]
    found, errors, counts = fuse_matches([reference, *others], np.stack([xy, *matches]))
    np.testing.assert_allclose(found, points, atol=1e-6)
    assert errors.max() < 1e-6
    assert (counts == 5).all()


def test_noise_is_averaged_over_the_views(scene, monkeypatch: pytest.MonkeyPatch) -> None:
    reference, others, xy, points = scene
    rng = np.random.default_rng(1)
    matches = [other.project(points)[0] + rng.normal(0, 0.1, xy.shape) for other in others]
    several, errors, counts = fuse_matches([reference, *others], np.stack([xy, *matches]))
    monkeypatch.setattr(dense, "MIN_VIEWS", 2)
    single, _, _ = fuse_matches([reference, *others[2:3]], np.stack([xy, *matches[2:3]]))
    good = counts > 0
    assert good.mean() > 0.95
    assert 0.05 < np.median(errors[good]) < 0.15
    depth_errors = [
        np.median(np.abs(each[good, 2] - points[good, 2])) for each in (several, single)
    ]
    assert depth_errors[0] < 0.6 * depth_errors[1]


def test_a_wrong_match_is_outvoted(scene) -> None:
    reference, others, xy, points = scene
    matches = [other.project(points)[0] for other in others]
    matches[1] = matches[1] + (40, 0)
    matches[3] = matches[3] - (25, 0)
    found, errors, counts = fuse_matches([reference, *others], np.stack([xy, *matches]))
    np.testing.assert_allclose(found, points, atol=1e-6)
    assert (counts == 3).all()
    assert errors.max() < 1e-6


def test_two_views_are_not_enough(scene, monkeypatch: pytest.MonkeyPatch) -> None:
    reference, others, xy, points = scene
    matches = [other.project(points)[0] for other in others[:2]]
    matches[1][:250] = np.nan  # there is no match
    matches[1][250:] += (30, 0)  # a match that contradicts
    _, _, counts = fuse_matches([reference, *others[:2]], np.stack([xy, *matches]))
    assert not counts.any()
    monkeypatch.setattr(dense, "MIN_VIEWS", 2)
    _, _, counts = fuse_matches([reference, *others[:2]], np.stack([xy, *matches]))
    assert (counts >= 2).all()


def test_points_without_parallax_or_behind_the_cameras_are_left_out(scene) -> None:
    reference, _, xy, _ = scene
    near = [view(x) for x in (0.01, 0.02, 0.03)]
    far = reference.camera.rays(xy) * 6
    matches = [other.project(far)[0] for other in near]
    assert not fuse_matches([reference, *near], np.stack([xy, *matches]))[2].any()
    wide = [view(x) for x in (-1.0, 1.0, 0.5)]
    behind = [other.project(-far)[0] for other in wide]
    assert np.isfinite(behind[0]).all()
    assert not fuse_matches([reference, *wide], np.stack([xy, *behind]))[2].any()


def surface(reference: PosedView, depth: float = 6.0, stride: int = 2) -> np.ndarray:
    """Return the points of a plane in the world that a view shows, one at each second pixel."""
    y, x = np.mgrid[0 : SIZE[1] : stride, 0 : SIZE[0] : stride]
    rays = reference.camera.rays(np.column_stack([x.ravel(), y.ravel()])) @ reference.rotation
    points = reference.centre + rays * ((depth - reference.centre[2]) / rays[:, 2:])
    made = np.ones(len(points), DENSE_POINT)
    made["points"] = points
    return made


def test_what_two_references_show_is_kept_once() -> None:
    first, second = view(0), view(0.5)
    parts = [(first, surface(first)), (second, surface(second))]
    merged = merge_dense_points(parts, 2)
    new = len(merged) - len(parts[0][1])
    projected, _ = first.project(parts[1][1]["points"])
    outside = (~((projected > -1) & (projected < SIZE)).all(axis=1)).sum()
    assert outside > 300
    assert outside <= new < 1.3 * outside + 600
    assert len(merge_dense_points(parts[:1], 2)) == len(parts[0][1])


def test_another_surface_is_no_duplicate() -> None:
    first, second = view(0), view(0.01)
    parts = [(first, surface(first, 6.0)), (second, surface(second, 5.0))]
    assert len(merge_dense_points(parts, 2)) == len(parts[0][1]) + len(parts[1][1])


def test_neighbours_share_points_at_a_good_angle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dense, "NEIGHBOURS", 2)
    points = np.random.default_rng(0).uniform((-1, -1, 5.5), (1, 1, 6.5), (200, 3))

    def model(step: int) -> SparseModel:
        """Cameras that see every so many of the points."""
        rows = np.arange(0, 200, step)
        images = {}
        for x in (0.0, 0.02, 0.6, 1.2, 9.0):
            own = view(x, str(x))
            intrinsics = CameraIntrinsics.of_camera(own.camera)
            images[own.name] = RegisteredImage(
                own, intrinsics, rows, own.project(points[rows])[0], rows
            )
        return SparseModel(images, points, np.zeros(200), np.full(200, 5))

    found = {first.view.name: others for first, *others in find_references(model(1))}
    assert {each.view.name for each in found["0.0"]} == {"0.6", "1.2"}
    assert find_references(model(10)) == []


def test_a_smaller_view_sees_the_same_directions(monkeypatch: pytest.MonkeyPatch) -> None:
    own = view(0.5)
    assert limited_view(own) is own
    monkeypatch.setattr(dense, "MAX_SIDE_PX", 160)
    small = limited_view(own)
    assert small.camera.size == (160, 120)
    points = np.array([[0.3, -0.2, 6.0]])
    expected = (own.project(points)[0] + 0.5) / 2 - 0.5
    np.testing.assert_allclose(small.project(points)[0], expected)


def test_what_was_extracted_is_not_too_large(tmp_path: Path, photo: np.ndarray) -> None:
    Image.fromarray(photo).save(tmp_path / "a.png")
    camera = CameraIntrinsics("PINHOLE", photo.shape[1::-1], (1.0, 1.0, 0.0, 0.0))
    with read_with(
        reading_options(max_megapixels=1e-3)
    ):  # as in another process than that of the command
        rgb = dense._prepared_image(tmp_path / "a.png", (0, 0), camera, camera.size)
    np.testing.assert_array_equal(rgb, photo)
