from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from deepdetect._shared.errors import OptionError
from deepdetect.features.selection import (
    GRID_CELLS,
    SelectionOptions,
    descending_order,
    grid_subsample,
    select_keypoints,
    spread_over_grid,
    suppress_neighbors,
)


def bayer(bits: int) -> np.ndarray:
    """The dither matrix of 2^bits rows, from its definition by smaller ones."""
    if bits == 0:
        return np.zeros((1, 1), int)
    smaller = 4 ** (bits - 1) * np.array([[0, 2], [3, 1]])
    tiles = 2 ** (bits - 1)
    return np.tile(smaller, (tiles, tiles)) + np.repeat(np.repeat(bayer(bits - 1), 2, 0), 2, 1)


def ranked(
    scores: list[tuple[float, int, int]], shape: tuple[int, ...]
) -> list[tuple[float, int, int]]:
    order = bayer(max(1, (max(shape) - 1).bit_length()))
    return sorted(scores, key=lambda one: (-one[0], order[one[1], one[2]]))


def reference(
    heatmap: np.ndarray, options: SelectionOptions, ignore: np.ndarray | None = None
) -> list[tuple[int, int]]:
    """Select by plain loops: the (x, y) in the order of rows and columns."""
    limit = options.threshold if options.density is None else 0
    height, width = heatmap.shape
    candidates = ranked(
        [
            (float(heatmap[row, column]), row, column)
            for row in range(height)
            for column in range(width)
            if heatmap[row, column] > limit and not (ignore is not None and ignore[row, column])
        ],
        heatmap.shape,
    )
    radius = options.nms_radius
    kept: list[tuple[float, int, int]] = []
    for position, one in enumerate(candidates):
        near = (
            abs(one[1] - better[1]) <= radius and abs(one[2] - better[2]) <= radius
            for better in candidates[:position]
        )
        if not radius or not any(near):
            kept.append(one)
    if options.density is not None:
        kept = kept[: round(options.density * heatmap.size)]
    if options.max_keypoints is not None:
        kept = kept[: options.max_keypoints]
    return [(column, row) for _, row, column in sorted(kept, key=lambda one: one[1:])]


# Few levels, so that there are many ties, beside any probability.
LEVELS = st.sampled_from([0.0, 0.25, 0.5, 0.75, 1.0]) | st.floats(0, 1, width=32)
SHAPES = st.tuples(st.integers(1, 12), st.integers(1, 12))


@given(data=st.data(), shape=SHAPES)
def test_equals_plain_loops(data: st.DataObject, shape: tuple[int, int]) -> None:
    heatmap = data.draw(arrays(np.float32, shape, elements=LEVELS))
    options = SelectionOptions(
        threshold=data.draw(st.sampled_from([0.0, 0.25, 0.5, 0.6])),
        density=data.draw(st.none() | st.floats(0.01, 1)),
        max_keypoints=data.draw(st.none() | st.integers(1, 20)),
        nms_radius=data.draw(st.integers(0, 4)),
    )
    ignore = data.draw(st.none() | arrays(bool, shape))
    keypoints = select_keypoints(heatmap, options, ignore=ignore)
    found = [(round(float(x)), round(float(y))) for x, y in keypoints]
    assert found == reference(heatmap, options, ignore)
    assert keypoints.image_size == (shape[1], shape[0])
    assert keypoints.scores.tolist() == [float(heatmap[y, x]) for x, y in found]


def test_the_threshold_is_strict() -> None:
    heatmap = np.zeros((16, 20), np.float32)
    heatmap[3, 4] = 0.5
    heatmap[7, 2] = np.nextafter(np.float32(0.5), np.float32(1))
    assert select_keypoints(heatmap).xy.tolist() == [[2, 7]]
    assert select_keypoints(heatmap, SelectionOptions(0.0)).xy.tolist() == [[4, 3], [2, 7]]
    assert len(select_keypoints(np.ones((16, 20), np.float32), SelectionOptions(1.0))) == 0


@pytest.mark.parametrize("density", [0.001, 0.1, 0.25, 0.333, 1.0])
def test_the_density_is_exact(density: float) -> None:
    heatmap = np.random.default_rng(0).uniform(0.01, 0.2, (37, 53)).astype(np.float32)
    keypoints = select_keypoints(heatmap, SelectionOptions(threshold=0.9, density=density))
    count = round(density * 37 * 53)
    assert len(keypoints) == count
    # They are the most probable ones.
    assert keypoints.scores.min() == np.sort(heatmap.ravel())[-count]


def test_a_density_takes_no_impossible_pixel() -> None:
    heatmap = np.zeros((20, 20), np.float32)
    heatmap[5, 5] = 0.1
    assert len(select_keypoints(heatmap, SelectionOptions(density=0.5))) == 1


@pytest.mark.parametrize(
    "options", [SelectionOptions(max_keypoints=3), SelectionOptions(density=3 / 400)]
)
def test_ties_do_not_go_before_better_ones(options: SelectionOptions) -> None:
    heatmap = np.zeros((20, 20), np.float32)
    for row, column in [(2, 9), (2, 15), (4, 0), (11, 3)]:
        heatmap[row, column] = 0.75
    heatmap[19, 19] = 0.9
    found = select_keypoints(heatmap, options).xy.tolist()
    assert len(found) == 3
    assert [19, 19] in found


@pytest.mark.parametrize("radius", [0, 1])
@pytest.mark.parametrize("count", [16, 64, 500])
def test_ties_are_spread_over_the_image(radius: int, count: int) -> None:
    """The network's probabilities are 1 to the last bit on a tenth of an image."""
    heatmap = np.ones((120, 200), np.float32)
    options = SelectionOptions(max_keypoints=count, nms_radius=radius)
    xy = select_keypoints(heatmap, options).xy
    cells = (xy // (50, 60)).astype(int)
    share = np.bincount(cells[:, 1] * 4 + cells[:, 0], minlength=8) / count
    np.testing.assert_allclose(share, 1 / 8, atol=1.1 / count + 0.03)


@pytest.mark.parametrize("shape", [(31, 24), (24, 31, 1), ()])
def test_an_ignore_mask_of_another_size(shape: tuple[int, ...]) -> None:
    heatmap = np.zeros((24, 31), np.float32)
    with pytest.raises(OptionError, match=r"\(24, 31\)"):
        select_keypoints(heatmap, ignore=np.zeros(shape, bool))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("threshold", 1.1),
        ("density", 0),
        ("density", 1.5),
        ("max_keypoints", 0),
        ("nms_radius", -1),
    ],
)
def test_options_out_of_range(name: str, value: float) -> None:
    with pytest.raises(OptionError, match=name):
        SelectionOptions(**{name: value})


# Ranking by logits, and positions between pixels.


def sigmoid(logits: np.ndarray) -> np.ndarray:
    return (1 / (1 + np.exp(-logits.astype(np.float64)))).astype(np.float32)


def test_logits_rank_what_float32_rounds_to_one() -> None:
    logits = np.full((24, 24), -5, np.float32)
    places = [(3, 4), (20, 7), (11, 19), (5, 15)]  # (x, y), from the worst to the best
    for level, (x, y) in zip((20, 30, 40, 50), places, strict=True):
        logits[y, x] = level
    heatmap = sigmoid(logits)
    assert (heatmap[logits > 0] == 1).all()
    for count in (1, 2, 3):
        found = select_keypoints(heatmap, SelectionOptions(max_keypoints=count), logits)
        assert {tuple(xy) for xy in found.xy.tolist()} == set(places[-count:])
        assert found.logits is not None
        assert sorted(found.logits.tolist()) == [20, 30, 40, 50][-count:]
        assert found.best(1).xy.tolist() == [[5, 15]]


@pytest.mark.parametrize(("x", "y"), [(12.0, 9.0), (12.3, 9.0), (11.6, 9.45), (12.25, 8.75)])
def test_the_peak_of_a_paraboloid_is_found(x: float, y: float) -> None:
    row, column = np.indices((20, 24))
    heatmap = (0.9 - 0.01 * (column - x) ** 2 - 0.02 * (row - y) ** 2).clip(0).astype(np.float32)
    found = select_keypoints(heatmap, SelectionOptions(max_keypoints=1, subpixel=True))
    np.testing.assert_allclose(found.xy, [[x, y]], atol=1e-4)
    whole = select_keypoints(heatmap, SelectionOptions(max_keypoints=1))
    np.testing.assert_array_equal(whole.xy, [[round(x), round(y)]])
    alone = select_keypoints(heatmap, SelectionOptions(nms_radius=30, subpixel=True))
    np.testing.assert_allclose(alone.xy, [[x, y]], atol=1e-4)


@given(heatmap=arrays(np.float32, SHAPES, elements=LEVELS))
def test_a_refined_keypoint_stays_with_its_pixel(heatmap: np.ndarray) -> None:
    whole = select_keypoints(heatmap, SelectionOptions(0.1))
    refined = select_keypoints(heatmap, SelectionOptions(0.1, subpixel=True))
    np.testing.assert_array_equal(np.rint(refined.xy), whole.xy)
    height, width = heatmap.shape
    assert (refined.xy >= 0).all()
    assert (refined.xy <= (width - 1, height - 1)).all()


def test_grid_subsample_takes_one_of_each_cell() -> None:
    points = np.random.default_rng(0).uniform(0, 100, (5000, 2))
    rows = grid_subsample(points, 10)
    assert len(rows) == 100
    assert len(np.unique(points[rows] // 10, axis=0)) == 100
    assert (np.diff(rows) > 0).all()
    np.testing.assert_array_equal(rows, grid_subsample(points, 10))
    assert (rows != grid_subsample(points, 10, seed=1)).any()


@pytest.mark.parametrize("seed", range(3))
def test_of_two_radii_the_smaller_one_counts(seed: int) -> None:
    generator = np.random.default_rng(seed)
    xy = generator.uniform(-3, 30, (300, 2))
    scores, radii = generator.integers(20, size=300), generator.uniform(0.5, 6, 300)
    kept: list[int] = []
    for row in np.argsort(-scores, kind="stable"):
        gaps = np.linalg.norm(xy[kept] - xy[row], axis=1)
        if (gaps >= np.minimum(radii[kept], radii[row])).all():
            kept.append(int(row))
    assert suppress_neighbors(xy, scores, radii).tolist() == kept
    assert suppress_neighbors(xy, scores, radii, 7).tolist() == kept[:7]


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int64])
def test_descending_order_is_that_of_a_stable_sort(dtype: type) -> None:
    values = np.random.default_rng(0).integers(-9, 9, 200).astype(dtype) / 2
    values = np.concatenate([values, [-0.0, 0.0]]).astype(dtype)
    expected = np.argsort(-values, kind="stable")
    np.testing.assert_array_equal(descending_order(values), expected)


def cells_of(xy: np.ndarray, size: tuple[int, int]) -> list[tuple[int, int]]:
    side = max(size) / GRID_CELLS
    return [(int(x // side), int(y // side)) for x, y in xy]


@given(
    count=st.integers(0, 80),
    most=st.integers(0, 90),
    size=st.tuples(st.integers(1, 500), st.integers(1, 500)),
    clumped=st.floats(0, 3),
    seed=st.integers(0, 2**32 - 1),
)
def test_spread_takes_cells_in_turn(
    count: int, most: int, size: tuple[int, int], clumped: float, seed: int
) -> None:
    generator = np.random.default_rng(seed)
    xy = generator.random((count, 2)) ** (1 + clumped) * size
    strength = generator.permutation(count).astype(float)
    rows = spread_over_grid(xy, strength, size, most).tolist()
    assert len(rows) == len(set(rows)) == min(count, most)
    cell = cells_of(xy, size)
    waiting = {
        one: sorted((k for k in range(count) if cell[k] == one), key=lambda k: -strength[k])
        for one in set(cell)
    }
    expected = []
    while any(waiting.values()):
        turn = [members.pop(0) for members in waiting.values() if members]
        expected += sorted(turn, key=lambda k: -strength[k])
    assert rows == expected[:most]
