"""Dense points of synthetic depth maps, whose points are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

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


def tilted(own: PosedView, stride: int = 2, slope: float = 0.5) -> np.ndarray:
    """Return the exact depth map of the plane z = 6 + slope x."""
    y, x = np.mgrid[0 : SIZE[1] : stride, 0 : SIZE[0] : stride]
    rays = own.camera.rays(np.column_stack([x.ravel(), y.ravel()]))
    # Of a point X = centre + t ray: its z - slope x - 6 is 0, and t is its depth.
    plane = np.array([-slope, 0, 1])
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


@pytest.mark.parametrize(("factor", "agree"), [(1.008, True), (1.03, False)])
def test_depths_may_differ_by_a_hundredth(factor: float, agree: bool) -> None:
    views = [view(x) for x in (0, -0.15, 0.15)]
    maps = [tilted(each) for each in views]
    maps[0]["plane"] *= factor  # less than a pixel away
    assert bool(len(fuse_depth_maps(views, maps, 2))) == agree


def test_no_other_depth_map_gives_no_points() -> None:
    assert not len(fuse_depth_maps([REFERENCE], [tilted(REFERENCE)], 2))


def test_two_depth_maps_are_not_enough() -> None:
    views = [REFERENCE, *OTHERS[:2]]
    maps = [tilted(each) for each in views]
    maps[1]["plane"][:, :80, 0] *= 1.1
    maps[2]["plane"][...] = np.nan
    assert not len(fuse_depth_maps(views, maps, 2))


Layer = tuple[int, slice, slice, float]
ROWS, COLUMNS, NEAR, FAR = slice(20, 100), slice(60, 120), 1 / 6, 1 / 12


def agreed_by(
    *layers: Layer,
    others: Sequence[float] = (-0.8, -0.4, 0.4, 0.8),
    behind: float = np.nan,
    stride: int = 2,
    last_columns: int = 160,
) -> np.ndarray:
    """Return which of 120 x 160 pixels of the depth map of the reference become points.

    The cameras are at 0 and `others` and do not turn; the map of the last one has fewer columns. A
    layer is how many depth maps have a surface parallel to the image, its pixels in the reference,
    and its inverse depth; the others have the inverse depth `behind` there, if any, as all have
    where no layer is.
    """
    views, maps = [], []
    for number, x in enumerate((0.0, *others)):
        made = np.zeros((120, 160), DEPTH_PIXEL)
        made["plane"][..., 0] = behind
        for count, rows, columns, inverse in layers:
            shown = np.zeros(made.shape, bool)
            shown[rows, columns] = True
            shown = np.roll(shown, -round(150.0 * x * inverse), axis=1)
            made["plane"][shown, 0] = inverse if number < count else behind
        if number == len(others):
            made = made[:, :last_columns]
        camera = Camera(
            (made.shape[1] * stride, 120 * stride), 150.0 * stride, (80.0 * stride, 60.0 * stride)
        )
        views.append(PosedView("", camera, np.eye(3), np.array([-x, 0.0, 0.0])))
        maps.append(made)
    found = np.zeros((120, 160), bool)
    projected, _ = views[0].project(fuse_depth_maps(views, maps, stride)["points"])
    column, row = np.rint(projected / stride).astype(int).T
    found[row, column] = True
    return found


@pytest.mark.parametrize("stride", [1, 2, 4])
def test_two_depth_maps_fill_eight_pixels_around_the_middle_of_a_surface(stride: int) -> None:
    # As many pixels of an image: the middle of the surface reaches to its end.
    hole, filled = slice(75, 101), 8 // stride
    layers = (3, ROWS, slice(20, 160), NEAR), (2, ROWS, hole, NEAR)
    found = agreed_by(*layers, others=(-0.8, -0.4, -0.2, -0.1), stride=stride)
    assert found[50:70, 30 : 75 + filled].all()
    assert not found[50:70, 75 + filled : 101 - filled].any()
    assert found[50:70, 101 - filled : 120].all()


def test_small_patches_need_five_depth_maps() -> None:
    """A patch must have 15 of the 25 pixels, five apart, around its middle."""
    strip, narrower = slice(80, 91), slice(80, 90)
    assert agreed_by((3, ROWS, strip, NEAR))[40:80, strip].all()
    assert not agreed_by((4, ROWS, narrower, NEAR)).any()
    assert agreed_by((5, ROWS, narrower, NEAR), others=(-0.8, -0.4, 0.4, 0.8, 0.2))[
        40:80, narrower
    ].all()
    assert not agreed_by((4, slice(40, 60), strip, NEAR)).any()
    assert agreed_by((4, slice(40, 61), strip, NEAR))[50, strip].all()


def test_all_four_depth_maps_that_show_a_place_are_enough() -> None:
    patch = ROWS, slice(80, 84), NEAR
    three = -0.8, -0.4, 0.4
    assert agreed_by((4, *patch), others=three)[40:80, 80:84].all()
    assert agreed_by((4, *patch), others=(*three, 8.0))[40:80, 80:84].all()
    assert not agreed_by((4, *patch), others=(*three, 0.8)).any()
    assert not agreed_by((3, *patch), others=three).any()
    assert not agreed_by((3, *patch), others=three[:2]).any()


def test_an_image_shows_no_more_than_its_own_pixels() -> None:
    left, right = (4, ROWS, slice(20, 24), NEAR), (4, ROWS, slice(100, 104), NEAR)
    assert not agreed_by(left, right).any()
    found = agreed_by(left, right, last_columns=60)
    assert not found[:, :50].any()
    assert found[40:80, 100:104].all()


def test_what_lies_at_another_depth_is_no_part_of_a_surface() -> None:
    speck = slice(55, 60), slice(85, 90)
    found = agreed_by((5, ROWS, COLUMNS, NEAR), (2, *speck, FAR))
    assert not found[speck].any()
    assert found[30:50, 66:114].all()
    rows = [(3, slice(row, row + 3), COLUMNS, FAR) for row in range(20, 100, 8)]
    found = agreed_by((5, ROWS, COLUMNS, NEAR), *rows)[:, 66:114]
    assert not found[44:47].any()
    assert found[47:52].all()


def test_fewer_than_five_depth_maps_make_no_points_beside_a_farther_surface() -> None:
    found = agreed_by((4, ROWS, COLUMNS, NEAR), behind=FAR)
    assert found[40:80, 64:116].all()
    assert not found[40:80, 60:64].any()
    assert not found[40:80, 116:120].any()
    assert agreed_by((5, ROWS, COLUMNS, NEAR), behind=FAR)[40:80, 61:119].all()


def test_a_wrong_depth_of_one_map_makes_no_edge() -> None:
    wrong = slice(60, 61), slice(90, 91)
    found = agreed_by((4, ROWS, COLUMNS, NEAR), (1, *wrong, FAR))
    assert found[wrong].sum() == 0
    assert found[55:66, 85:96].sum() == 11 * 11 - 1


def test_a_farther_surface_that_no_other_image_sees_makes_an_edge() -> None:
    """So does what is too far for an angle."""
    wall = 4, ROWS, COLUMNS, NEAR
    far = agreed_by(wall, behind=1 / 1200)
    beside = agreed_by(wall, (1, ROWS, slice(40, 60), FAR))
    for found in (far, beside):
        assert not found[40:80, 60:64].any()
        assert found[40:80, 64:110].all()


def test_surfaces_reach_the_corners_of_the_image() -> None:
    everywhere = slice(0, 120), slice(0, 160)
    found = agreed_by((3, *everywhere, NEAR), others=(-0.8, -0.4, -0.6, -0.2))
    assert found[:, :100].all()


@pytest.mark.parametrize("stride", [1, 2, 4])
def test_steep_surfaces_have_no_edges(stride: int) -> None:
    views = [REFERENCE, *(view(x) for x in (0.4, -0.4, 0.2, -0.2))]
    maps = [tilted(each, stride, 2.0) for each in views]
    known = fuse_depth_maps(views, maps, stride)
    for each in maps[3:]:
        each["plane"] = np.nan
    found = fuse_depth_maps(views, maps, stride)
    assert len(found) > 0.9 * len(known) > 0.6 * SIZE[0] * SIZE[1] / stride**2


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
