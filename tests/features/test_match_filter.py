from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from deepdetect import Keypoints, OptionError, PointDetector, match_features
from deepdetect.features.match_filter import filter_inputs, nearest_rows
from deepdetect.features.matchers import DescriptorMatches
from deepdetect.geometry.transforms import transfer_errors

TURNED = np.array([[0.6, -0.35, 100], [0.35, 0.6, 10], [0.0002, 0, 1]])


@pytest.fixture(scope="module", params=["learned", "rootsift"])
def pair(request, photo: np.ndarray) -> tuple[Keypoints, Keypoints]:
    """Keypoints of a photograph and of a smaller, turned view of it."""
    view = cv2.warpPerspective(photo, TURNED, (256, 256), flags=cv2.INTER_AREA)
    detector = PointDetector(1000, descriptor=request.param)
    return detector.extract(photo), detector.extract(view)


def right(matches) -> np.ndarray:
    return transfer_errors(matches.points0, matches.points1, TURNED) < 3


def test_it_keeps_more_right_matches_than_a_ratio_as_precise(pair) -> None:
    kept = right(match_features(*pair, filter_by="neighbours"))
    every = match_features(*pair, ratio=1)
    found = right(every)[np.argsort(-every.scores)].cumsum()
    precision = found / np.arange(1, len(found) + 1)
    assert kept.mean() > 0.8
    assert kept.sum() > 1.05 * found[precision >= kept.mean()].max(initial=0)


def test_scores_say_how_likely_matches_are_right(pair) -> None:
    matches = match_features(*pair, filter_by="neighbours")
    assert ((matches.scores > 0.5) & (matches.scores <= 1)).all()
    good = matches.scores > np.median(matches.scores)
    assert right(matches)[good].mean() > right(matches)[~good].mean()


def test_unrelated_images_hardly_match(pair, photo: np.ndarray) -> None:
    noise = np.random.default_rng(0).normal(0, 1, (2, 256, 256))
    other = sum(
        cv2.GaussianBlur(noise[k], (0, 0), sigma) * sigma for k, sigma in ((0, 1.5), (1, 4))
    )
    other = np.uint8(255 * (other - other.min()) / np.ptp(other))
    described = PointDetector(1000, descriptor=pair[0].descriptor_type).extract(other)
    assert len(match_features(pair[0], described, filter_by="neighbours")) < 10


def test_the_order_of_images_changes_little(pair) -> None:
    first, second = pair
    there = match_features(first, second, filter_by="neighbours")
    back = match_features(second, first, filter_by="neighbours")
    pairs = [set(zip(m.indices0, m.indices1, strict=True)) for m in (there, back.swapped())]
    assert len(pairs[0] & pairs[1]) > 0.9 * len(pairs[0] | pairs[1])


@pytest.mark.parametrize("count", [0, 1, 8])
def test_of_too_few_matches_none_is_kept(pair, count: int) -> None:
    first, second = pair
    matches = match_features(first, second, filter_by="neighbours")
    few = first[matches.indices0[:count]], second[matches.indices1[:count]]
    assert len(match_features(*few, filter_by="neighbours")) == 0


def test_of_few_right_matches_most_are_kept(pair) -> None:
    first, second = pair
    matches = match_features(first, second, filter_by="neighbours")
    rows = np.flatnonzero(right(matches))[:: max(1, right(matches).sum() // 20)][:20]
    few = first[matches.indices0[rows]], second[matches.indices1[rows]]
    assert len(match_features(*few, filter_by="neighbours")) >= 12


def test_one_image_is_turned_back() -> None:
    rng = np.random.default_rng(2)
    xy, c, s = rng.uniform(0, 200, (40, 2)), np.cos(np.radians(70)), np.sin(np.radians(70))
    there = xy @ np.array([[c, s], [-s, c]])  # by 70 degrees from x to y
    angles = rng.uniform(0, 360, 40)
    common = {"scores": np.ones(40), "image_size": (400, 400), "sizes": np.full(40, 5.0)}
    first = Keypoints(xy=xy, angles=angles, **common)
    second = Keypoints(xy=there, angles=(angles + 70) % 360, **common)
    rows = np.arange(40, dtype=np.int32)
    values = filter_inputs(first, second, DescriptorMatches(rows, rows, np.full(40, 0.5)))
    np.testing.assert_allclose(values["xy1"], values["xy0"], atol=1e-3)
    np.testing.assert_allclose(np.cos(values["turns"]), 1, atol=1e-5)


def test_the_nearest_rows_are_those_of_others() -> None:
    xy = np.random.default_rng(1).uniform(0, 50, (40, 2)).astype(np.float32)
    xy[3] = xy[4]
    gaps = np.linalg.norm(xy[:, None] - xy, axis=2)
    np.fill_diagonal(gaps, np.inf)
    rows = nearest_rows(xy)
    assert not (rows == np.arange(40)[:, None]).any()
    np.testing.assert_allclose(
        np.take_along_axis(gaps, rows, 1), np.sort(gaps, 1)[:, :8], atol=1e-4
    )
    assert (nearest_rows(np.zeros((12, 2), np.float32)) != np.arange(12)[:, None]).all()


def test_what_does_not_suit_is_refused(pair) -> None:
    first, second = pair
    for options in ({"ratio": 0.9}, {"mutual": False}):
        with pytest.raises(OptionError, match="`ratio`"):
            match_features(first, second, filter_by="neighbours", **options)
    with pytest.raises(OptionError, match="filter_by"):
        match_features(first, second, filter_by="neighbors")
    flat = np.zeros(len(first), np.float32)
    for changes in ({"sizes": None}, {"sizes": flat}, {"angles": flat - 1}):
        with pytest.raises(OptionError):
            match_features(dataclasses.replace(first, **changes), second, filter_by="neighbours")
    other = [dataclasses.replace(each, descriptor_type="cross-modal") for each in pair]
    with pytest.raises(OptionError):
        match_features(*other, filter_by="neighbours")
