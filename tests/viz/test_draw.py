from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from deepdetect import DeepDetectError, Keypoints, OptionError
from deepdetect.features.display import PICTURE_SIDE_PX, draw_matches
from deepdetect.viz.draw import (
    CAPTION_HEIGHT,
    add_caption,
    draw_best_keypoints,
    draw_dense_keypoints,
    draw_depth,
    draw_heatmap,
    draw_logits,
    save_picture,
)


def test_heat_map_colours_are_viridis() -> None:
    from matplotlib import colormaps

    levels = np.linspace(0, 1, 256, dtype=np.float32)[None].repeat(16, 0)
    expected = colormaps["viridis"](levels)[..., :3] * 255
    assert np.abs(draw_heatmap(levels).astype(float) - expected).max() <= 2


def test_a_picture_ends_in_png_or_jpg(tmp_path: Path) -> None:
    picture = np.full((20, 30, 3), (200, 30, 90), np.uint8)
    for ending in (".png", ".jpg", ".JPEG"):
        save_picture(picture, tmp_path / f"deep/a{ending}")
        with Image.open(tmp_path / f"deep/a{ending}") as found:
            assert np.abs(np.asarray(found).astype(int) - picture).max() < 8
    with pytest.raises(OptionError):
        save_picture(picture, tmp_path / "a.bmp")
    assert not (tmp_path / "a.bmp").exists()


def test_a_picture_too_large_for_its_format_is_refused(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    wide = np.zeros((2, 65_501, 3), np.uint8)
    for name in ("p.jpg", "p.JPEG"):
        with pytest.raises(DeepDetectError, match="65501x2"):
            save_picture(wide, tmp_path / name)
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr().err == ""
    save_picture(wide[:, :-1], tmp_path / "p.jpg")
    save_picture(wide, tmp_path / "p.png")
    with Image.open(tmp_path / "p.png") as picture:
        assert picture.size == (65_501, 2)


def large_photo(photo: np.ndarray) -> np.ndarray:
    """The photograph at six megapixels, with noise as of a camera."""
    large = cv2.resize(photo, (3072, 2048), interpolation=cv2.INTER_CUBIC)
    noise = np.random.default_rng(0).normal(0, 6, large.shape)
    return np.clip(large + noise, 0, 255).astype(np.uint8)


def test_pictures_of_large_photographs_are_small_and_legible(
    photo: np.ndarray, tmp_path: Path
) -> None:
    rgb = large_photo(photo)
    rows, columns = np.nonzero(cv2.Laplacian(rgb[..., 1], cv2.CV_32F) > 12)
    keypoints = Keypoints(
        np.stack([columns, rows], 1), np.ones(len(rows)), (3072, 2048), np.arange(len(rows))
    )
    logits = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) / np.float32(4) - 20
    points = keypoints.xy[::50]
    pictures = [
        draw_best_keypoints(rgb, keypoints),
        draw_dense_keypoints(rgb, keypoints),
        draw_logits(logits),
        draw_depth(np.where(logits > -5, logits + 30, np.nan), "mm"),
        add_caption(
            draw_matches(*(rgb, rgb, points, points, np.ones(len(points), bool)), by_position=True),
            "matches",
        ),
    ]
    for picture in pictures:
        assert picture.shape[1] == PICTURE_SIDE_PX
        save_picture(picture, tmp_path / "p.jpg")
        assert (tmp_path / "p.jpg").stat().st_size < 2e6
        caption = picture[-round(CAPTION_HEIGHT * PICTURE_SIDE_PX / 800) :, : PICTURE_SIDE_PX // 2]
        written = np.flatnonzero((caption.min(2) > 200).any(1))
        assert np.ptp(written) > 0.012 * PICTURE_SIDE_PX  # letters, when it is fitted to a screen


def test_the_best_keypoints_of_all_parts_are_shown_by_score(photo: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 255, (5000, 2))
    logits = xy[:, 0] / 10
    picture = draw_best_keypoints(photo, Keypoints(xy, np.ones(5000), (256, 256), logits))
    colored = np.ptp(picture[:256].astype(int), axis=2) > 30
    assert colored[:, :64].any()
    assert colored[:, 192:].any()
    # From blue to yellow.
    left, right = (picture[:256][:, part] for part in (slice(0, 40), slice(216, 256)))
    of = [colored[:, :40], colored[:, 216:]]
    assert left[of[0]][:, 2].mean() > left[of[0]][:, 0].mean() + 20
    assert right[of[1]][:, 0].mean() > right[of[1]][:, 2].mean() + 20


def test_a_map_of_logits_is_not_saturated() -> None:
    logits = np.linspace(-12, 40, 200, dtype=np.float32)[None].repeat(20, 0)
    picture = draw_logits(logits)[:20]
    assert len(np.unique(picture[0], axis=0)) > 150
    flat = draw_logits(np.full((20, 30), -np.inf, np.float32))
    assert (flat[:20] == flat[0, 0]).all()


def test_a_depth_map_is_bright_where_it_is_near() -> None:
    depth = np.full((30, 60), np.nan, np.float32)
    depth[:, :20], depth[:, 40:] = 100, 900
    picture = draw_depth(depth, "mm")
    assert picture[15, 10].sum() > picture[15, 50].sum() + 100
    assert not picture[15, 30].any()
    assert draw_depth(np.full((30, 60), np.nan), "mm").shape[1] == 60
