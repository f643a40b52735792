"""Dense points of synthetic depth maps, whose points are known."""

from __future__ import annotations

import numpy as np

from deepdetect.geometry.camera import Camera, PosedView
from deepdetect.sfm.depth_maps import DEPTH_PIXEL
from deepdetect.sfm.fusion import DENSE_POINT, fuse_depth_maps, merge_dense_points

SIZE = (320, 240)


def view(x: float, name: str = "") -> PosedView:
    """Return a camera at (x, 0, 0) that looks at (0, 0, 6)."""
    angle = np.arctan2(x, 6)
    rotation = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    return PosedView(name, Camera(SIZE, 300.0), rotation, -rotation @ [x, 0, 0])


def tilted(own: PosedView, stride: int = 2) -> np.ndarray:
    """Return the exact depth map of the plane z = 6 + x / 2."""
    y, x = np.mgrid[0 : SIZE[1] : stride, 0 : SIZE[0] : stride]
    rays = own.camera.rays(np.column_stack([x.ravel(), y.ravel()]))
    # Of a point X = centre + t ray: its z - x / 2 - 6 is 0, and t is its depth.
    plane = np.array([-0.5, 0, 1])
    inverse = (rays @ own.rotation @ plane) / (6 - own.centre @ plane)
    made = np.zeros(x.shape, DEPTH_PIXEL)
    made["plane"][..., 0] = inverse.reshape(x.shape)
    # Linear in the position: the slopes are those of neighbouring pixels.
    made["plane"][..., 2], made["plane"][..., 1] = (
        each / stride for each in np.gradient(made["plane"][..., 0].astype(np.float64))
    )
    made["error"], made["color"] = 0.25, (10, 20, 30)
    return made


REFERENCE, OTHERS = view(0), [view(x) for x in (-1.0, -0.5, 0.5, 1.0)]


def test_exact_depth_maps_give_points_and_normals() -> None:
    views = [REFERENCE, *OTHERS]
    found = fuse_depth_maps(views, [tilted(each) for each in views], 2)
    points = found["points"]
    assert len(found) > 0.9 * SIZE[0] * SIZE[1] / 4
    np.testing.assert_allclose(points[:, 2], 6 + points[:, 0] / 2, atol=1e-4)
    np.testing.assert_allclose(
        found["normals"], [np.array([0.5, 0, -1]) / 1.25**0.5] * len(found), atol=1e-3
    )
    assert found["views"].max() == 5
    assert (found["errors"] == 0.25).all()
    assert (found["colors"] == (10, 20, 30)).all()


def test_noise_is_averaged_over_the_depth_maps() -> None:
    views = [REFERENCE, *OTHERS]
    rng = np.random.default_rng(1)
    maps = [tilted(each) for each in views]
    for each in maps:
        each["plane"][..., 0] *= 1 + rng.normal(0, 0.001, each.shape)
    found = fuse_depth_maps(views, maps, 2)
    found = found[found["views"] == 5]
    inverse = 1 / found["points"][:, 2]
    noise = inverse * (6 + found["points"][:, 0] / 2) - 1
    assert len(found) > 1000
    assert np.std(noise) < 0.6 * 0.001


def test_a_wrong_depth_map_is_outvoted() -> None:
    views = [REFERENCE, *OTHERS]
    maps = [tilted(each) for each in views]
    maps[1]["plane"][..., 0] *= 1.1
    maps[3]["plane"] = np.nan
    found = fuse_depth_maps(views, maps, 2)
    points = found["points"]
    np.testing.assert_allclose(points[:, 2], 6 + points[:, 0] / 2, atol=1e-4)
    # Two at the borders, which some images do not show.
    assert found["views"].max() == 3
    assert (found["views"] == 3).mean() > 0.8
    assert len(found) > 5000


def test_two_depth_maps_are_not_enough() -> None:
    views = [REFERENCE, *OTHERS[:2]]
    maps = [tilted(each) for each in views]
    maps[1]["plane"][:, :80, 0] *= 1.1
    maps[2]["plane"][...] = np.nan
    assert not len(fuse_depth_maps(views, maps, 2))


def cells(found: np.ndarray) -> np.ndarray:
    """Return which pixels of the depth map of the reference are points."""
    shown = np.zeros((SIZE[1] // 2, SIZE[0] // 2), bool)
    column, row = np.rint(REFERENCE.project(found["points"])[0] / 2).astype(int).T
    shown[row, column] = True
    return shown


def agreed_by(*counts: tuple[int, slice, slice], behind: float = np.nan) -> np.ndarray:
    """Return the pixels that become points if so many depth maps agree there.

    Elsewhere all have the inverse depth `behind`, if any.
    """
    views = [REFERENCE, *OTHERS]
    known = np.zeros((len(views), SIZE[1] // 2, SIZE[0] // 2), bool)
    for count, rows, columns in counts:
        known[:, rows, columns] = np.arange(len(views))[:, None, None] < count
    # The cameras do not turn: surfaces parallel to the image are shifted along rows alone.
    ahead = [PosedView("", each.camera, np.eye(3), -each.centre) for each in views]
    maps = []
    for each, own in zip(ahead, known, strict=True):
        made = np.zeros(own.shape, DEPTH_PIXEL)
        shift = round(300.0 * each.centre[0] / 6 / 2)
        made["plane"][..., 0] = np.where(np.roll(own, -shift, axis=1), 1 / 6, behind)
        maps.append(made)
    return cells(fuse_depth_maps(ahead, maps, 2))


def test_holes_of_a_surface_are_filled_by_two_depth_maps() -> None:
    rows, whole = slice(20, 100), slice(60, 120)
    found = agreed_by((3, rows, whole), (2, rows, slice(80, 84)))
    assert found[30:90, 65:115].all()
    wide = agreed_by((3, rows, whole), (2, rows, slice(75, 95)))
    assert wide[30:90, 65:75].all()
    assert not wide[30:90, 81:89].any()


def test_edges_of_a_nearer_surface_need_five_depth_maps() -> None:
    rows, whole = slice(20, 100), slice(60, 120)
    four = agreed_by((4, rows, whole), behind=1 / 12)
    assert four[30:90, 66:114].all()
    assert not four[30:90, 60:63].any()
    assert not four[30:90, 117:120].any()
    assert agreed_by((5, rows, whole), behind=1 / 12)[30:90, 61:119].all()


def test_small_patches_apart_need_five_depth_maps() -> None:
    patch = slice(50, 60), slice(80, 90)
    assert not agreed_by((4, *patch)).any()
    assert agreed_by((5, *patch))[51:59, 82:88].all()


def test_points_without_parallax_or_behind_the_cameras_are_left_out() -> None:
    near = [REFERENCE, *(view(x) for x in (0.01, 0.02, 0.03))]
    assert not len(fuse_depth_maps(near, [tilted(each) for each in near], 2))
    views = [REFERENCE, *OTHERS]
    maps = [tilted(each) for each in views]
    for each in maps:
        each["plane"] *= -1
    assert not len(fuse_depth_maps(views, maps, 2))


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
