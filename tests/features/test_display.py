from __future__ import annotations

import base64
import re
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from deepdetect import ImageError, Keypoints, Matches
from deepdetect.viz.draw import GREEN, RED


def keypoints(count: int, size: tuple[int, int] = (256, 256), **columns: Any) -> Keypoints:
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 1, (count, 2)) * np.subtract(size, 1)
    return Keypoints(xy, np.ones(count), size, **columns)


def matches(
    points0: np.ndarray,
    points1: np.ndarray,
    inliers: list[bool],
    sizes: tuple[tuple[int, int], tuple[int, int]] = ((60, 50), (60, 50)),
) -> Matches:
    scores = np.ones(len(points0))
    ends = [Keypoints(xy, scores, size) for xy, size in zip((points0, points1), sizes, strict=True)]
    points = ends[0].xy, ends[1].xy
    return Matches(*points, scores, np.array(inliers, bool), *ends)


def test_dense_keypoints_colour_their_own_pixels_only() -> None:
    rgb = np.full((100, 120, 3), 100, np.uint8)
    row, column = np.divmod(np.arange(6000), 120)
    picture = Keypoints(np.stack([column, row], 1), np.ones(6000), (120, 100)).draw(rgb)
    greener = picture[..., 1] > picture[..., 0]
    assert greener[:50].all()
    assert not greener[50:].any()
    beyond = Keypoints([[119.6, 30]] * 6000, np.ones(6000), (120, 100)).draw(rgb)
    assert beyond[30, 119, 1] > 50


@pytest.mark.parametrize(("sizes", "diameter"), [(None, 6), ([24], 24), ([1], 4)])
def test_few_keypoints_are_circles_of_their_size(sizes: Any, diameter: int) -> None:
    rgb = np.zeros((80, 90, 3), np.uint8)
    rows, columns = np.nonzero(Keypoints([[40, 30]], [1], (90, 80), sizes=sizes).draw(rgb).any(2))
    assert abs(columns.mean() - 40) + abs(rows.mean() - 30) < 1
    assert abs(np.ptp(columns) - diameter) <= 2
    assert not rgb.any()


def test_images_of_any_kind_lie_below(photo: np.ndarray) -> None:
    points = keypoints(0)
    for image, channels in (
        (photo, "rgb"),
        (photo[..., ::-1], "bgr"),
        (photo.transpose(2, 0, 1), "rgb"),
        (Image.fromarray(photo), "bgr"),
    ):
        np.testing.assert_array_equal(points.draw(image, channels=channels), photo // 2)
    with pytest.raises(ImageError, match="100x256"):
        points.draw(photo[:, :100])
    with pytest.raises(ImageError, match="load_image"):
        points.draw("photo.png")


def test_match_lines_join_the_right_pixels() -> None:
    black = np.zeros((50, 60, 3), np.uint8)
    ends = np.array([[10, 5], [10, 40]]), np.array([[20, 5], [50, 40]])
    picture = matches(*ends, [True, False]).draw(black, black)
    assert picture.shape == (50, 120, 3)
    assert tuple(picture[5, 10]) == tuple(picture[5, 60 + 20]) == GREEN
    assert tuple(picture[40, 10]) == tuple(picture[40, 60 + 50]) == RED
    assert not picture[20:30].any()


def test_the_lower_image_is_enlarged_with_its_matches() -> None:
    """A white pixel of either image lies under its end of the line, and nothing is left black."""
    first, second = np.full((60, 40, 3), 90, np.uint8), np.full((30, 50, 3), 90, np.uint8)
    ends = np.array([[10, 20]]), np.array([[30, 10]])
    picture = matches(*ends, [True], ((40, 60), (50, 30))).draw(first, second)
    assert picture.shape == (60, 40 + 100, 3)
    assert tuple(picture[20, 10]) == GREEN
    assert tuple(picture[20, 40 + 60]) == GREEN  # (30, 10) is at (60.5, 20.5) in twice the size
    assert picture.any(axis=2).all()


def test_matches_have_the_colour_of_their_position() -> None:
    black = np.zeros((60, 80, 3), np.uint8)
    points0, points1 = (
        np.array([[10, 10], [70, 50], [40, 30]]),
        np.array([[12, 20], [60, 5], [1, 55]]),
    )
    found = matches(points0, points1, [True, True, False], ((80, 60), (80, 60)))
    picture = found.draw(black, black, by_position=True)
    colors = [picture[y, x] for x, y in points0]
    np.testing.assert_array_equal(colors, [picture[y, x + 80] for x, y in points1])
    assert np.abs(colors[0].astype(int) - colors[1]).max() > 100
    assert tuple(colors[2]) == RED


@pytest.mark.parametrize("size", [(640, 480), (20, 3000)])
@pytest.mark.parametrize("count", [0, 200_000])
def test_what_a_notebook_shows_is_small(size: tuple[int, int], count: int) -> None:
    points = keypoints(count, size)
    good = np.arange(count) % 4 > 0
    crossed = Matches(points.xy, points.xy[::-1], points.scores, good, points, points[::-1])
    for thing, pictures in ((points, 1), (crossed, 2)):
        text = thing._repr_html_()
        assert len(text) < 20_000
        assert f"{count:,} " in text
        assert f"{size[0]}x{size[1]}" in text
        data = base64.b64decode(re.search(r'base64,([^"]+)"', text)[1])
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert picture.shape[0] <= 240
        assert picture.shape[1] <= 240 * pictures
        assert bool(picture.any()) == bool(count)
