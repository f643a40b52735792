from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from deepdetect import Keypoints
from deepdetect.features.pictures import draw_best_keypoints, draw_dense_keypoints
from deepdetect.io.picture_file import save_picture
from deepdetect.viz.draw import (
    CAPTION_HEIGHT,
    PICTURE_SIDE_PX,
    add_caption,
    draw_depth,
    draw_logits,
    draw_matches,
)


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
