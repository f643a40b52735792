from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from deepdetect import DeepDetect
from deepdetect.errors import OptionError
from deepdetect.keypoints import Keypoints, SelectionOptions, select_keypoints

POINTS = Keypoints([[1, 2], [3, 4], [5, 0]], [0.9, 0.6, 0.7], (8, 5))


# The container.


def test_values_are_kept_as_float32() -> None:
    assert POINTS.xy.dtype == np.float32
    assert POINTS.scores.dtype == np.float32
    assert POINTS.xy.tolist() == [[1, 2], [3, 4], [5, 0]]
    assert POINTS.image_size == (8, 5)
    assert len(POINTS) == 3
    assert POINTS.density == pytest.approx(3 / 40)


def test_iteration_goes_over_rows() -> None:
    assert [tuple(point.tolist()) for point in POINTS] == [(1, 2), (3, 4), (5, 0)]
    x, y = next(iter(POINTS))
    assert (x, y) == (1, 2)


@pytest.mark.parametrize(
    ("index", "kept"),
    [
        (slice(1, None), [1, 2]),
        (slice(None, None, -1), [2, 1, 0]),
        (slice(0, 0), []),
        ([2, 0], [2, 0]),
        ([], []),
        (np.array([1, 1]), [1, 1]),
        (np.array([True, False, True]), [0, 2]),
        (np.zeros(3, bool), []),
        (1, [1]),
        (-1, [2]),
        (np.int64(2), [2]),
    ],
)
def test_indexing(index: object, kept: list[int]) -> None:
    part = POINTS[index]
    assert isinstance(part, Keypoints)
    assert part.image_size == POINTS.image_size
    assert part.xy.shape == (len(kept), 2)
    np.testing.assert_array_equal(part.xy, POINTS.xy[kept].reshape(-1, 2))
    np.testing.assert_array_equal(part.scores, POINTS.scores[kept])


@pytest.mark.parametrize("index", [3, -4, [7], np.array([True])])
def test_indexing_out_of_range(index: object) -> None:
    with pytest.raises(IndexError):
        POINTS[index]


@pytest.mark.parametrize(
    "empty",
    [Keypoints.empty((8, 5)), Keypoints([], [], (8, 5)), Keypoints(np.empty((0, 2)), [], (8, 5))],
    ids=["empty()", "lists", "arrays"],
)
def test_no_keypoint(empty: Keypoints) -> None:
    assert len(empty) == 0
    assert empty.xy.shape == (0, 2)
    assert empty.scores.shape == (0,)
    assert list(empty) == []
    assert empty.density == 0
    assert len(empty[:]) == 0


@pytest.mark.parametrize(
    ("xy", "scores"),
    [
        ([[1, 2]], [0.5, 0.6]),
        ([[1, 2], [3, 4]], [0.5]),
        ([[1, 2, 3]], [0.5]),
        ([1, 2], [0.5]),
        ([[1, 2]], 0.5),
        ([[1, 2]], [[0.5]]),
        ([], [0.5]),
        ([[1, 2]], []),
    ],
)
def test_shapes_that_do_not_fit(xy: list, scores: list) -> None:
    with pytest.raises(OptionError, match=r"keypoints need \(N, 2\) positions"):
        Keypoints(xy, scores, (8, 5))


# The selection.


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


def reference(heatmap: np.ndarray, options: SelectionOptions) -> list[tuple[int, int]]:
    """Select by plain loops: the (x, y) in the order of rows and columns."""
    limit = options.threshold if options.density is None else 0
    height, width = heatmap.shape
    candidates = ranked(
        [
            (float(heatmap[row, column]), row, column)
            for row in range(height)
            for column in range(width)
            if heatmap[row, column] > limit
            and not (options.ignore is not None and options.ignore[row, column])
        ],
        heatmap.shape,
    )
    radius = options.nms_radius
    kept: list[tuple[float, int, int]] = []
    for one in candidates:
        near = (
            abs(one[1] - better[1]) <= radius and abs(one[2] - better[2]) <= radius
            for better in kept
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


@settings(max_examples=300)
@given(data=st.data(), shape=SHAPES)
def test_equals_plain_loops(data: st.DataObject, shape: tuple[int, int]) -> None:
    heatmap = data.draw(arrays(np.float32, shape, elements=LEVELS))
    options = SelectionOptions(
        threshold=data.draw(st.sampled_from([0.0, 0.25, 0.5, 0.6])),
        density=data.draw(st.none() | st.floats(0.01, 1)),
        max_keypoints=data.draw(st.none() | st.integers(1, 20)),
        nms_radius=data.draw(st.integers(0, 4)),
        ignore=data.draw(st.none() | arrays(bool, shape)),
    )
    keypoints = select_keypoints(heatmap, options)
    found = [(int(x), int(y)) for x, y in keypoints]
    assert found == reference(heatmap, options)
    assert keypoints.image_size == (shape[1], shape[0])
    assert keypoints.scores.tolist() == [float(heatmap[y, x]) for x, y in found]


@given(
    heatmap=arrays(np.float32, st.tuples(st.integers(1, 20), st.integers(1, 20)), elements=LEVELS),
    radius=st.integers(1, 25),
)
def test_suppressed_keypoints_keep_their_distance(heatmap: np.ndarray, radius: int) -> None:
    keypoints = select_keypoints(heatmap, SelectionOptions(0.25, nms_radius=radius))
    xy = keypoints.xy
    distance = np.abs(xy[:, None] - xy[None]).max(2)
    np.fill_diagonal(distance, np.inf)
    assert len(xy) == 0 or distance.min() > radius
    # The most probable pixel is always kept.
    if (heatmap > 0.25).any():
        assert keypoints.scores.max() == heatmap.max()


def test_a_ramp_is_thinned_and_not_emptied() -> None:
    """Its top suppresses the next pixel only, so the one after that is kept again."""
    heatmap = np.zeros((16, 16), np.float32)
    heatmap[4, 2:12] = np.linspace(0.6, 0.9, 10)
    keypoints = select_keypoints(heatmap, SelectionOptions(nms_radius=1))
    assert keypoints.xy.tolist() == [[3, 4], [5, 4], [7, 4], [9, 4], [11, 4]]


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


@pytest.mark.parametrize("count", [1, 7, 100, 10_000])
def test_the_most_probable_are_kept(count: int) -> None:
    heatmap = np.random.default_rng(1).random((30, 40)).astype(np.float32)
    keypoints = select_keypoints(heatmap, SelectionOptions(0.5, max_keypoints=count))
    best = np.sort(heatmap[heatmap > 0.5])[::-1][:count]
    np.testing.assert_array_equal(np.sort(keypoints.scores)[::-1], best)


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


def test_the_network_s_best_keypoints_span_a_photograph(photo: np.ndarray) -> None:
    keypoints = DeepDetect().detect(photo, max_keypoints=300)
    cells = (keypoints.xy // 64).astype(int)
    assert len(np.unique(cells[:, 1] * 4 + cells[:, 0])) >= 14


def test_a_plateau_leaves_its_first_pixel() -> None:
    heatmap = np.full((9, 9), 0.8, np.float32)
    keypoints = select_keypoints(heatmap, SelectionOptions(nms_radius=20))
    assert keypoints.xy.tolist() == [[0, 0]]


def test_suppression_goes_before_the_number() -> None:
    heatmap = np.zeros((16, 16), np.float32)
    heatmap[4, 4], heatmap[4, 5], heatmap[10, 10] = 0.9, 0.8, 0.7
    options = SelectionOptions(max_keypoints=2, nms_radius=1)
    assert select_keypoints(heatmap, options).xy.tolist() == [[4, 4], [10, 10]]


def test_ignored_pixels_suppress_nothing() -> None:
    heatmap = np.zeros((16, 16), np.float32)
    heatmap[4, 4], heatmap[4, 5] = 0.9, 0.8
    ignore = np.zeros((16, 16), bool)
    ignore[4, 4] = True
    options = SelectionOptions(nms_radius=3, ignore=ignore)
    assert select_keypoints(heatmap, options).xy.tolist() == [[5, 4]]


@pytest.mark.parametrize("kind", [bool, np.uint8, np.int32, np.float32])
def test_an_ignore_mask_of_any_number_type(kind: type) -> None:
    heatmap = np.random.default_rng(2).random((24, 31)).astype(np.float32)
    ignore = np.zeros((24, 31), kind)
    ignore[5:15, 10:20] = 1
    ignore[0, 0] = 1
    keypoints = select_keypoints(heatmap, SelectionOptions(0.5, ignore=ignore))
    expected = (heatmap > 0.5) & (ignore == 0)
    x, y = keypoints.xy.astype(int).T
    np.testing.assert_array_equal(np.argwhere(expected), np.stack([y, x], 1))


@pytest.mark.parametrize("shape", [(31, 24), (24, 30), (24, 31, 1), (24,), ()])
def test_an_ignore_mask_of_another_size(shape: tuple[int, ...]) -> None:
    heatmap = np.zeros((24, 31), np.float32)
    with pytest.raises(OptionError, match="ignore mask has shape") as caught:
        select_keypoints(heatmap, SelectionOptions(ignore=np.zeros(shape, bool)))
    assert "(24, 31)" in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"threshold": -0.1}, "threshold must lie in [0, 1], not -0.1"),
        ({"threshold": 1.1}, "threshold must lie in [0, 1], not 1.1"),
        ({"threshold": float("nan")}, "threshold must lie in [0, 1], not nan"),
        ({"density": 0}, "density must lie in (0, 1], not 0"),
        ({"density": 1.5}, "density must lie in (0, 1], not 1.5"),
        ({"density": float("nan")}, "density must lie in (0, 1], not nan"),
        ({"max_keypoints": 0}, "max_keypoints must be at least 1, not 0"),
        ({"nms_radius": -1}, "nms_radius must be 0 or more pixels, not -1"),
    ],
)
def test_options_out_of_range(changes: dict[str, float], words: str) -> None:
    with pytest.raises(OptionError) as caught:
        SelectionOptions(**changes)
    assert words in str(caught.value)


def test_the_heat_map_is_left_as_it_was() -> None:
    heatmap = np.random.default_rng(5).random((20, 20)).astype(np.float32)
    before = heatmap.copy()
    select_keypoints(heatmap, SelectionOptions(0.2, max_keypoints=9, nms_radius=2))
    np.testing.assert_array_equal(heatmap, before)
