from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from deepdetect.io.image import load_image, luma
from deepdetect.io.masks import load_mask
from deepdetect.viz.draw import CAPTION_HEIGHT
from deepdetect_lab.labels import (
    DETECTOR_NAMES,
    DETECTORS,
    Label,
    LabelOptions,
    draw_label,
    fuse,
    visibility_of,
)


@pytest.fixture(scope="module")
def single(gray: np.ndarray) -> dict[tuple[str, str], np.ndarray]:
    """What each detector marks by itself, in each of its settings."""
    masks = {}
    for name, detector in DETECTORS.items():
        masks[name, "normal"] = detector.mask(gray)
        masks[name, "low"] = detector.mask(gray, **detector.low_visibility)
    return masks


@pytest.mark.parametrize("visibility", ["normal", "low"])
def test_the_or_of_all_parts(visibility: str, gray: np.ndarray, single: dict) -> None:
    label = fuse(gray, LabelOptions(visibility=visibility))
    edges = single["canny", visibility] | single["sobel", visibility]
    points = np.zeros_like(edges)
    for name in set(DETECTOR_NAMES) - {"canny", "sobel"}:
        points = points | single[name, visibility]
    assert label.visibility == visibility
    assert label.mask.dtype == bool
    np.testing.assert_array_equal(label.edges, edges)
    np.testing.assert_array_equal(label.keypoints, points)
    np.testing.assert_array_equal(label.mask, edges | points)
    assert label.density == pytest.approx((edges | points).sum() / gray.size)
    assert 0 < label.density < 1


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(255, 255, "low"), (0, 63, "low"), (0, 64, "normal"), (180, 243, "low"), (180, 244, "normal")],
)
def test_low_visibility_at_its_limit(low: int, high: int, expected: str) -> None:
    gray = np.full((20, 20), low, np.uint8)
    gray[:, 10:] = high
    assert visibility_of(gray) == expected


@given(arrays(np.uint8, st.tuples(st.integers(1, 30), st.integers(1, 30))))
def test_the_range_is_that_of_two_percentiles(gray: np.ndarray) -> None:
    low, high = np.percentile(gray, [1, 99], method="inverted_cdf").astype(int)
    assert visibility_of(gray) == ("low" if high - low < 64 else "normal")


def published(shared: Path) -> list[tuple[Path, bool]]:
    """The published images, and whether each is dark."""
    first_dark = {"train": 32986, "val": 35996}
    root = shared / "data" / "label-samples"
    return [
        (path, int(path.stem.removeprefix("image_")) >= first)
        for split, first in first_dark.items()
        for path in sorted((root / split).glob("image_*.png"))
    ]


@pytest.mark.parametrize(
    ("step", "overlap"), [(10, 0.991), pytest.param(1, 0.996, marks=pytest.mark.slow)]
)
def test_the_published_labels(step: int, overlap: float, shared: Path) -> None:
    scores: dict[bool, list[float]] = {False: [], True: []}
    for path, is_dark in published(shared)[::step]:
        rgb = load_image(path)
        # The dark ones are stored with red and blue swapped.
        gray = cv2.cvtColor(rgb, cv2.COLOR_BGR2GRAY) if is_dark else luma(rgb)
        truth = load_mask(path.with_name(f"mask_{path.name}"))
        label = fuse(gray)
        assert label.visibility == ("low" if is_dark else "normal"), path.name
        scores[is_dark].append((label.mask & truth).sum() / (label.mask | truth).sum())
    count = 20 // step
    assert {is_dark: len(values) for is_dark, values in scores.items()} == {
        False: count,
        True: count,
    }
    assert np.mean(scores[False]) >= overlap
    assert min(scores[True]) == 1.0


def test_the_figure_has_the_mask_of_each_half() -> None:
    rgb = np.full((20, 200, 3), 90, np.uint8)
    keypoints, edges = np.zeros((2, 20, 200), bool)
    keypoints[:10], edges[:, :50] = True, True
    figure = draw_label(rgb, Label(keypoints, edges, "low"))
    assert figure.shape == (20 + CAPTION_HEIGHT, 4 * 200 + 3 * 6, 3)
    panels = [figure[:20, k * 206 : k * 206 + 200] for k in range(4)]
    np.testing.assert_array_equal(panels[0], rgb)
    for panel, mask in zip(panels[1:], (keypoints, edges, keypoints | edges), strict=True):
        np.testing.assert_array_equal(panel, np.repeat(mask[..., None] * np.uint8(255), 3, 2))
