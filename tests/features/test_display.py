from __future__ import annotations

import base64
import builtins
import dataclasses
import re
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from deepdetect import ImageError, Keypoints, Matches, MissingExtraError


def keypoints(count: int, size: tuple[int, int] = (256, 256), **columns: Any) -> Keypoints:
    rng = np.random.default_rng(0)
    return Keypoints(rng.uniform(0, 1, (count, 2)) * size - 0.5, np.ones(count), size, **columns)


def matches(count: int, size: tuple[int, int] = (256, 256)) -> Matches:
    points = keypoints(count, size)
    inliers = np.arange(count) % 4 > 0
    return Matches(points.xy, points.xy, points.scores, inliers, "none", None, points, points)


@pytest.fixture
def axes() -> Any:
    """Axes that need no display."""
    figures = pytest.importorskip("matplotlib.figure", reason="needs matplotlib")
    return figures.Figure().subplots()


@pytest.mark.parametrize("count", [0, 3, 6000])
@pytest.mark.parametrize("sized", [False, True])
def test_keypoints_are_plotted_where_they_are(axes: Any, count: int, sized: bool) -> None:
    points = keypoints(count, sizes=np.arange(count)) if sized else keypoints(count)
    assert points.plot(axes=axes) is axes
    if sized and count <= 5000:
        (drawn,) = axes.collections
        np.testing.assert_allclose(drawn.get_offsets().reshape(-1, 2), points.xy)
        np.testing.assert_allclose(drawn._widths * 2, np.arange(count))
    else:
        (line,) = axes.lines
        np.testing.assert_array_equal(line.get_xydata(), points.xy)
    axes.figure.canvas.draw()


def test_images_of_any_kind_lie_below(axes: Any, photo: np.ndarray) -> None:
    points = keypoints(5)
    for image, channels in (
        (photo, "rgb"),
        (photo[..., ::-1], "bgr"),
        (photo.transpose(2, 0, 1), "rgb"),
        (Image.fromarray(photo), "bgr"),
    ):
        points.plot(image, axes=axes, channels=channels)
        np.testing.assert_array_equal(axes.images[-1].get_array(), photo)
    with pytest.raises(ImageError, match="100x256 pixels, the keypoints are of one of 256x256"):
        points.plot(photo[:, :100], axes=axes)
    with pytest.raises(ImageError, match=r"give load_image\(path\)"):
        points.plot("photo.png", axes=axes)


def test_matches_are_lines_between_the_images(axes: Any, photo: np.ndarray) -> None:
    found = matches(200)
    assert found.plot(photo, photo, axes=axes, lines=40) is axes
    (shown,) = axes.images
    assert shown.get_array().shape == (256, 512, 3)
    lines = axes.collections[0]
    segments = np.array(lines.get_segments())
    assert segments.shape == (40, 2, 2)
    np.testing.assert_allclose(segments[:, 0] + (256, 0), segments[:, 1], rtol=1e-6)
    ends = {tuple(xy) for xy in found.points0.tolist()}
    assert all(tuple(np.float32(xy).tolist()) in ends for xy in segments[:, 0])
    green = (lines.get_colors()[:, 1] == 1).sum()
    assert green == sum(
        bool(found.inliers[(found.points0 == np.float32(xy)).all(axis=1)][0])
        for xy in segments[:, 0]
    )
    axes.figure.canvas.draw()


def test_a_figure_is_made_where_there_are_no_axes() -> None:
    matplotlib = pytest.importorskip("matplotlib", reason="needs matplotlib")
    matplotlib.use("agg")
    from matplotlib import pyplot

    axes = matches(3).plot()
    assert axes.figure in map(pyplot.figure, pyplot.get_fignums())
    pyplot.close(axes.figure)


def test_without_matplotlib_it_is_one_sentence(monkeypatch: pytest.MonkeyPatch, one_line) -> None:
    real = builtins.__import__

    def missing(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", missing)
    for thing in (keypoints(3), matches(3)):
        with pytest.raises(MissingExtraError, match="pip install matplotlib") as caught:
            thing.plot()
        one_line(caught.value)


@pytest.mark.parametrize("size", [(640, 480), (6000, 4000), (20, 3000)])
@pytest.mark.parametrize("count", [0, 1, 200_000])
def test_what_a_notebook_shows_is_small(size: tuple[int, int], count: int) -> None:
    crossed = dataclasses.replace(matches(count, size), points1=matches(count, size).points0[::-1])
    for thing, pictures in ((keypoints(count, size), 1), (crossed, 2)):
        text = thing._repr_html_()
        assert len(text) < 20_000
        assert f"{count:,} " in text
        assert f"{size[0]}x{size[1]}" in text
        data = base64.b64decode(re.search(r'base64,([^"]+)"', text)[1])
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert picture.shape[0] <= 240
        assert picture.shape[1] <= 240 * pictures
        assert bool(picture.any()) == bool(count)
