from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from deepdetect import DeepDetectError, Keypoints, OptionError
from deepdetect.viz.draw import (
    GREEN,
    RED,
    add_caption,
    draw_heatmap,
    draw_keypoints,
    draw_matches,
    save_picture,
    vstack,
)


def test_heat_map_colours_are_viridis() -> None:
    from matplotlib import colormaps

    levels = np.linspace(0, 1, 256, dtype=np.float32)[None].repeat(16, 0)
    expected = colormaps["viridis"](levels)[..., :3] * 255
    assert np.abs(draw_heatmap(levels).astype(float) - expected).max() <= 2


def test_dense_keypoints_colour_their_own_pixels_only() -> None:
    rgb = np.full((100, 120, 3), 100, np.uint8)
    row, column = np.divmod(np.arange(6000), 120)
    picture = draw_keypoints(rgb, Keypoints(np.stack([column, row], 1), np.ones(6000), (120, 100)))
    greener = picture[..., 1] > picture[..., 0]
    assert greener[:50].all()
    assert not greener[50:].any()


def test_sparse_keypoints_are_circles_around_them() -> None:
    rgb = np.zeros((40, 60, 3), np.uint8)
    picture = draw_keypoints(rgb, Keypoints([[30, 20]], [1], (60, 40)))
    rows, columns = np.nonzero(picture.any(2))
    assert (columns.mean(), rows.mean()) == (30, 20)


def test_match_lines_join_the_right_pixels() -> None:
    black = np.zeros((50, 60, 3), np.uint8)
    picture = draw_matches(
        black, black, np.array([[10, 5], [10, 40]]), np.array([[20, 5], [50, 40]]), [True, False]
    )
    assert picture.shape == (50, 120, 3)
    assert tuple(picture[5, 10]) == tuple(picture[5, 60 + 20]) == GREEN
    assert tuple(picture[40, 10]) == tuple(picture[40, 60 + 50]) == RED
    assert not picture[20:30].any()


def test_the_lower_image_is_enlarged_with_its_matches() -> None:
    """A white pixel of either image lies under its end of the line, and nothing is left black."""
    first, second = np.full((60, 40, 3), 90, np.uint8), np.full((30, 50, 3), 90, np.uint8)
    picture = draw_matches(first, second, np.array([[10, 20]]), np.array([[30, 10]]), [True])
    assert picture.shape == (60, 40 + 100, 3)
    assert tuple(picture[20, 10]) == GREEN
    assert tuple(picture[20, 40 + 60]) == GREEN  # (30, 10) is at (60.5, 20.5) in twice the size
    assert picture.any(axis=2).all()


def test_pictures_are_saved_as_they_are(tmp_path: Path) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (20, 30, 3), np.uint8)
    save_picture(rgb, tmp_path / "deep" / "p.png")
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "deep" / "p.png")), rgb)


def test_captions_fit_narrow_pictures() -> None:
    picture = add_caption(np.zeros((20, 60, 3), np.uint8), "a caption that is far too long")
    assert picture.shape[1] == 60
    assert picture[20:].any()
    assert not picture[20:, -2:].any()


def test_a_picture_ends_in_png_or_jpg(tmp_path: Path) -> None:
    picture = np.full((20, 30, 3), (200, 30, 90), np.uint8)
    for ending in (".png", ".jpg", ".JPEG"):
        save_picture(picture, tmp_path / f"a{ending}")
        with Image.open(tmp_path / f"a{ending}") as found:
            assert np.abs(np.asarray(found).astype(int) - picture).max() < 8
    with pytest.raises(OptionError, match="must end in"):
        save_picture(picture, tmp_path / "a.bmp")
    assert not (tmp_path / "a.bmp").exists()


def test_stacked_rows_are_padded_with_white() -> None:
    rows = [np.zeros((4, 10, 3), np.uint8), np.zeros((5, 6, 3), np.uint8)]
    picture = vstack(rows, gap=2)
    assert picture.shape == (11, 10, 3)
    assert not picture[:4].any()
    assert (picture[4:6] == 255).all()
    assert not picture[6:, :6].any()
    assert (picture[6:, 6:] == 255).all()


def test_a_picture_too_large_for_its_format_is_refused(
    tmp_path: Path, one_line: Callable[[BaseException], str], capfd: pytest.CaptureFixture[str]
) -> None:
    wide = np.zeros((2, 65_501, 3), np.uint8)
    for name in ("p.jpg", "p.JPEG"):
        with pytest.raises(DeepDetectError, match="65501x2 pixels: give it a name") as error:
            save_picture(wide, tmp_path / name)
        one_line(error.value)
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr().err == ""
    save_picture(wide[:, :-1], tmp_path / "p.jpg")
    save_picture(wide, tmp_path / "p.png")
    with Image.open(tmp_path / "p.png") as picture:
        assert picture.size == (65_501, 2)


def test_a_picture_that_opencv_does_not_encode_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*given: object) -> None:
        raise cv2.error("no memory")

    for encode in (lambda *given: (False, ()), fail):
        monkeypatch.setattr(cv2, "imencode", encode)
        with pytest.raises(DeepDetectError, match="cannot hold a picture of 30x20 pixels: make"):
            save_picture(np.zeros((20, 30, 3), np.uint8), tmp_path / "p.png")
    assert not list(tmp_path.iterdir())
