from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect._shared.errors import OptionError
from deepdetect.detector.points import detection
from deepdetect.detector.points.detection import detect_points, ranking_scores
from deepdetect.detector.points.hessian_scales import build_scale_space, find_candidates


@pytest.fixture(scope="module")
def gray() -> np.ndarray:
    generator = np.random.default_rng(3)
    layers = [
        cv2.GaussianBlur(generator.standard_normal((240, 320)), (0, 0), sigma) * sigma
        for sigma in (1.5, 3, 6)
    ]
    total = np.sum(layers, axis=0)
    return np.uint8(255 * (total - total.min()) / np.ptp(total))


def test_points_come_best_first_with_all_that_descriptors_need(gray) -> None:
    found = detect_points(gray, 300)
    assert len(found) == 300
    assert found.image_size == (320, 240)
    assert (np.diff(found.logits) <= 0).all()
    assert (np.diff(found.scores) < 0).all()
    level = np.log(found.sizes / 2.5 / 1.5) / np.log(1.35)
    np.testing.assert_allclose(level, np.rint(level), atol=1e-4)
    assert set(np.rint(level)) <= set(range(7))
    assert ((found.angles >= 0) & (found.angles < 360)).all()
    assert (found.xy % 1 != 0).mean() > 0.9  # sub-pixel


def test_fewer_are_the_best_of_more(gray) -> None:
    few, more = (detect_points(gray, n) for n in (100, 300))
    np.testing.assert_array_equal(few.xy, more.xy[:100])
    assert len(detect_points(gray)) > 1000


def test_no_two_are_nearer_than_the_distance_and_large_ones_keep_more(gray) -> None:
    points = detect_points(gray, 400)
    sigmas = points.sizes / detection.SIZE_PER_SIGMA
    gaps = np.linalg.norm(points.xy[:, None] - points.xy, axis=2) + 1e9 * np.eye(len(points))
    assert (gaps >= np.maximum(2, np.minimum(sigmas[:, None], sigmas)) - 1e-3).all()
    assert gaps.min() < 4  # small ones do not


@pytest.mark.parametrize(("shift", "near_px"), [((16, 8), 0.01), ((12, 7), 0.25)])
def test_positions_follow_a_shift_of_the_image(gray, shift, near_px) -> None:
    """Exactly if coarse levels have the same pixels, and nearly otherwise."""
    x, y = shift
    first = detect_points(gray[:200, :280], 200).xy
    second = detect_points(gray[y : y + 200, x : x + 280], 200).xy + shift
    inner = ((first > 50) & (first < (230, 150))).all(1)
    gaps = np.linalg.norm(first[inner, None] - second, axis=2).min(1)
    assert inner.sum() > 30
    assert np.mean(gaps < near_px) > 0.8


def test_a_zoomed_image_has_the_same_points_at_larger_sizes(gray) -> None:
    double = cv2.resize(gray, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    first = detect_points(gray, 150)
    second = detect_points(double, 600)
    mapped = (second.xy + 0.5) / 2 - 0.5
    gaps = np.linalg.norm(first.xy[:, None] - mapped, axis=2)
    nearest = gaps.argmin(1)
    found = gaps.min(1) < 1
    assert found.mean() > 0.7
    ratio = second.sizes[nearest[found]] / first.sizes[found]
    assert np.median(ratio) == pytest.approx(2, rel=0.25)


@pytest.mark.parametrize("spread", ["grid", "anms"])
def test_dim_regions_get_their_share_of_spread_points(spread, monkeypatch) -> None:
    """Also where the strongest candidates of an image all lie elsewhere."""
    noise = np.random.default_rng(5).standard_normal((300, 400))
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5)
    contrast = np.where(np.arange(400) < 200, 8, 80) / smooth.std() / 3
    shaded = np.uint8(np.clip(128 + smooth * contrast, 0, 255))
    monkeypatch.setattr(detection, "MIN_CANDIDATES", 100)
    found = detect_points(shaded, 200, spread=spread)
    assert np.mean(found.xy[:, 0] < 200) > 0.3


def test_no_point_is_where_the_mask_is_true(gray) -> None:
    ignore = np.zeros(gray.shape, bool)
    ignore[:, :160] = True
    found = detect_points(gray, 100, ignore=ignore)
    assert len(found) == 100
    assert found.xy[:, 0].min() > 159
    with pytest.raises(OptionError):
        detect_points(gray, ignore=ignore[1:])


@pytest.mark.parametrize("shape", [(1, 1), (3, 200), (40, 40)])
def test_images_without_structure_have_no_points(shape) -> None:
    found = detect_points(np.full(shape, 80, np.uint8), 10)
    assert len(found) == 0
    assert found.sizes is not None
    assert found.angles is not None


def test_the_strongest_candidates_are_enough(gray, monkeypatch) -> None:
    """Ranking a part of the candidates hardly changes the best."""
    everything = detect_points(gray)[:100]
    monkeypatch.setattr(detection, "MIN_CANDIDATES", 1)
    few = detect_points(gray, 100)
    assert len(find_candidates(build_scale_space(gray))) > 600
    same = (np.linalg.norm(few.xy[:, None] - everything.xy, axis=2).min(1) < 0.1).mean()
    assert same > 0.9


def test_equal_logits_get_falling_scores() -> None:
    logits = np.array([40, 40, 40, 39.99999, 0, 0, -1e9, -1e9], np.float32)
    scores = ranking_scores(logits)
    assert (np.diff(scores) < 0).all()
    expected = 0.5 + 0.5 * logits / (1 + np.abs(logits))
    np.testing.assert_allclose(scores, expected, atol=1e-6)
