from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from skimage import data

from deepdetect import OptionError
from deepdetect_lab.training.matcher.pairs import (
    NONE,
    UNKNOWN,
    Pair,
    draw_fixed,
    draw_moving,
    draw_pairs,
    draw_synthetic,
    predicted,
    read_pair,
)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("photographs")
    found = [folder / f"{k}.png" for k in range(3)]
    for file, photograph in zip(found, (data.astronaut, data.coffee, data.rocket), strict=True):
        cv2.imwrite(str(file), cv2.resize(photograph(), (720, 640))[..., ::-1])
    return found


def similarities(pair: Pair) -> np.ndarray:
    rows = np.flatnonzero(pair.partners0 >= 0)
    first, second = (pair.inputs[f"descriptors{k}"].astype(np.float32) for k in (0, 1))
    return (first[rows] * second[pair.partners0[rows]]).sum(1)


def check(pair: Pair | None) -> Pair:
    assert pair is not None
    rows = np.flatnonzero(pair.partners0 >= 0)
    np.testing.assert_array_equal(pair.partners1[pair.partners0[rows]], rows)
    assert min(pair.partners0.min(), pair.partners1.min()) >= UNKNOWN
    # Most corresponding keypoints look alike, others do not.
    assert np.median(similarities(pair)) > 0.5
    return pair


def test_partners_of_synthetic_views_look_alike(files: list[Path]) -> None:
    rng = np.random.default_rng(0)
    drawn = [draw_synthetic(rng, files) for _ in range(4)]
    found = [check(pair) for pair in drawn if pair is not None]
    assert found
    assert all((pair.partners0 == NONE).any() for pair in found)


def test_unrelated_views_have_no_partners(files: list[Path]) -> None:
    pair = draw_synthetic(np.random.default_rng(1), files, unrelated=True)
    assert pair is not None
    assert (pair.partners0 == NONE).all()
    assert (pair.partners1 == NONE).all()


def test_a_fixed_camera_shows_the_same_in_other_light(tmp_path: Path) -> None:
    photograph = cv2.resize(data.rocket(), (640, 430))
    for name, light in (("day", 1.0), ("dusk", 0.4)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), (photograph[..., ::-1] * light).astype(np.uint8))
    rng = np.random.default_rng(0)
    found = [draw_fixed(rng, [tmp_path]) for _ in range(6)]
    assert len([check(pair) for pair in found if pair is not None]) >= 3


def test_a_place_from_two_viewpoints_is_matched_first(tmp_path: Path) -> None:
    left, right, _ = data.stereo_motorcycle()
    for name, image in (("left", left), ("right", right)):
        small = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(tmp_path / f"{name}.png"), small[..., ::-1])
    pair = check(draw_moving(np.random.default_rng(0), [tmp_path]))
    # The views are rectified: corresponding keypoints lie in the same row.
    rows = np.flatnonzero(pair.partners0 >= 0)
    y0, y1 = pair.inputs["xy0"][rows, 1], pair.inputs["xy1"][pair.partners0[rows], 1]
    assert np.quantile(np.abs(y0 - y1), 0.9) * 370 < 3


def test_predictions_follow_the_dense_matches_around() -> None:
    x, y = np.meshgrid(np.arange(0.0, 60, 2), np.arange(0.0, 40, 2))
    points0 = np.column_stack([x.ravel(), y.ravel()])
    affinity, shift = np.array([[1.1, 0.1], [-0.2, 0.9]]), np.array([5.0, 7.0])
    points1 = points0 @ affinity.T + shift
    xy = np.array([[20.3, 11.7], [200.0, 5.0]])
    ends = predicted(xy, points0, points1)
    np.testing.assert_allclose(ends[0], xy[0] @ affinity.T + shift, atol=1e-9)
    assert np.isnan(ends[1]).all()


def test_drawing_goes_on_where_it_was_interrupted(files: list[Path], tmp_path: Path) -> None:
    first = draw_pairs(files, None, tmp_path, seed=3, count=1)
    written = first[0].stat().st_mtime_ns
    both = draw_pairs(files, None, tmp_path, seed=3, count=2)
    assert both[0].stat().st_mtime_ns == written
    assert read_pair(both[1]).partners0.max() > 0


def test_a_folder_of_places_without_places_is_an_error(files: list[Path], tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="no folders of photographs in 'fixed'"):
        draw_pairs(files, tmp_path, tmp_path / "pairs", seed=0, count=2)
