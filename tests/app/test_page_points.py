"""The page's points of all scales, run by node, beside the package's."""

from __future__ import annotations

from functools import partial
from itertools import product
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

import deepdetect
from deepdetect import Keypoints, load_image
from deepdetect.app.server import STATIC
from deepdetect.detector.points.descriptor import describe_learned
from deepdetect.detector.points.detection import detect_points, rank_candidates
from deepdetect.detector.points.hessian_scales import build_scale_space
from deepdetect.features.learned import RATIOS, match_learned, turn_descriptors
from deepdetect.features.matchers import exact_neighbours, match_descriptors
from deepdetect.io.image import luma

PHOTOS = ("coffee-turned.jpg", "motorcycle-left.jpg")

NEAR_PX = 1e-3
"""From a point of Python at which one of the page is the same: positions are float32 here."""

SHARED = 0.998
"""At least this fraction of the points is the same. Rounding moves two across their radius."""

SCORE = 1e-6
"""Largest difference of their scores."""

WRITE = """
const write = (numbers) =>
  writeFileSync(made, new Uint8Array(Float64Array.from(numbers).buffer));
"""


def gray_of(name: str) -> np.ndarray:
    return luma(load_image(STATIC / "examples" / name))


def points_in_node(
    run_node: Any, gray: np.ndarray, budgets: list[tuple[int, str]]
) -> list[np.ndarray]:
    """Return for each budget (N, 4): x, y, score and size of the page's points, best first.

    Of the package's candidates, with some of no strength behind the last, as ONNX Runtime has them.
    """
    imports = """
import { rankingOf } from "@/points/ranking.js";
import { choosePoints } from "@/points/detection.js";
"""
    script = """
const rows = new Float32Array(bytes);
const count = rows.length / 4;
const [x, y, sigmas, logits] = [0, 1, 2, 3].map((k) => rows.subarray(k * count, (k + 1) * count));
const ranking = { width, height, ...rankingOf({ x, y, sigmas, logits }) };
write(values.budgets.flatMap(([count, spread]) => {
  const { xy, scores, sizes } = choosePoints(ranking, count, spread);
  return [scores.length, ...Array.from(scores, (score, k) =>
    [xy[2 * k], xy[2 * k + 1], score, sizes[k]]).flat()];
}));
"""
    height, width = gray.shape
    candidates, logits = rank_candidates(build_scale_space(gray))
    columns = np.column_stack([candidates.xy, candidates.sigma_px, logits])
    behind = np.full((5, 4), (0, 0, 0, -np.inf))
    rows = np.concatenate([columns[np.argsort(candidates.rank)], behind]).T.astype(np.float32)
    found = run_node(imports, WRITE + script, rows, width=width, height=height, budgets=budgets)
    parts = []
    while len(found):
        count = int(found[0])
        parts.append(found[1 : 1 + 4 * count].reshape(-1, 4))
        found = found[1 + 4 * count :]
    return parts


def compare(found: np.ndarray, expected: Keypoints) -> float:
    """Check that points of the same place and size have the same score; return their share."""
    assert expected.sizes is not None
    assert abs(len(found) - len(expected)) <= (1 - SHARED) * len(expected)
    # Sizes differ by at least a pixel, so that levels lie apart as a third coordinate.
    places = np.column_stack([expected.xy, expected.sizes])
    distances, nearest = cKDTree(found[:, [0, 1, 3]]).query(places)
    same = distances < NEAR_PX
    assert np.abs(found[nearest[same], 2] - expected.scores[same]).max() < SCORE
    return float(same.mean())


BUDGETS = ((512, "none"), (2048, "none"), (512, "grid"), (512, "anms"))


@pytest.mark.parametrize("name", PHOTOS)
def test_the_points_of_a_photograph(name: str, run_node: Any) -> None:
    gray = np.ascontiguousarray(gray_of(name)[:300, :400])
    parts = points_in_node(run_node, gray, list(BUDGETS))
    for (count, spread), found in zip(BUDGETS, parts, strict=True):
        expected = detect_points(gray, count, spread=spread)
        assert compare(found, expected) >= SHARED, (count, spread)
        assert (np.diff(found[:, 2]) <= 0).all()


@pytest.mark.parametrize("shape", [(16, 17), (23, 31), (101, 99)], ids=str)
def test_few_points_of_small_pictures(shape: tuple[int, int], run_node: Any) -> None:
    """Smaller than the largest Gaussian, and with fewer points than are asked for, or one."""
    gray = np.ascontiguousarray(gray_of("motorcycle-left.jpg")[200 : 200 + shape[0], : shape[1]])
    budgets = list(product((1, 2, 5, 3000), ("none", "grid", "anms")))
    parts = points_in_node(run_node, gray, budgets)
    for (count, spread), found in zip(budgets, parts, strict=True):
        expected = detect_points(gray, count, spread=spread)
        assert len(found) == len(expected)
        assert compare(found, expected) == 1


def test_gaussian_is_that_of_opencv(run_node: Any) -> None:
    import cv2

    gray = np.ascontiguousarray(gray_of("coffee.jpg")[:151, :237])
    sigmas = (0.9, 1.36, 4.5, 11.1)
    found = run_node(
        'import { blur } from "@/gaussian.js";\n',
        WRITE
        + """const gray = new Uint8Array(bytes);
write(values.sigmas.flatMap((sigma) => Array.from(blur(gray, width, height, sigma))));
""",
        gray,
        width=237,
        height=151,
        sigmas=sigmas,
    )
    expected = [cv2.GaussianBlur(gray.astype(np.float32), (0, 0), sigma) for sigma in sigmas]
    np.testing.assert_allclose(found, np.ravel(expected), rtol=1e-6, atol=1e-5)


def test_angles(run_node: Any) -> None:
    gray = np.ascontiguousarray(gray_of("motorcycle-left.jpg")[:240, :320])
    points = detect_points(gray, 500)
    assert points.sizes is not None
    script = """
const [xy, sizes] = [Float32Array.from(values.xy), Float32Array.from(values.sizes)];
write(dominantAngles(new Uint8Array(bytes), width, height, { xy, sizes }));
"""
    found = run_node(
        'import { dominantAngles } from "@/orientation.js";\n',
        WRITE + script,
        gray,
        width=gray.shape[1],
        height=gray.shape[0],
        xy=points.xy.reshape(-1).tolist(),
        sizes=points.sizes.tolist(),
    )
    turned = np.abs((found - points.angles + 180) % 360 - 180)
    assert np.quantile(turned, 0.99) < 1e-3


@pytest.mark.parametrize("quarters", [0, 1])
def test_learned_descriptors_are_turned_and_matched_as_in_the_package(
    quarters: int, run_node: Any
) -> None:
    first, second = (gray_of(f"motorcycle-{side}.jpg") for side in ("left", "right"))
    features = [
        describe_learned(gray, detect_points(gray, 800))
        for gray in (first, np.ascontiguousarray(np.rot90(second, -quarters)))
    ]
    upright = [turn_descriptors(each.descriptors, each.angles) for each in features]
    script = """
const numbers = new Float32Array(bytes);
const middle = numbers.length / 2;
const [first, second] = [numbers.slice(0, middle), numbers.slice(middle)].map((half) => {
  const end = half.length / (LENGTH + 1) * LENGTH;
  return { upright: half.slice(0, end), angles: half.slice(end) };
});
const { rows0, rows1, ratios } = matchLearned(first, second);
write([...rows0].flatMap((row0, k) => ratios[k] < RATIO ? [row0, rows1[k]] : []));
"""
    found = run_node(
        'import { LENGTH, RATIO, matchLearned } from "@/learned.js";\n',
        WRITE + script,
        np.concatenate(
            [np.append(rows, each.angles) for rows, each in zip(upright, features, strict=True)]
        ).astype(np.float32),
        width=0,
        height=0,
    )
    limits = {"ratio": RATIOS["learned"], "mutual": True}
    match = partial(match_descriptors, matcher=exact_neighbours, **limits)
    expected, _ = match_learned(*features, match)
    pairs = set(zip(expected.indices0.tolist(), expected.indices1.tolist(), strict=True))
    common = pairs & {tuple(pair) for pair in found.reshape(-1, 2).astype(int).tolist()}
    assert len(common) >= SHARED * max(len(pairs), len(found) / 2) > 200


@pytest.mark.parametrize("size", [(1601, 1250), (1416, 1416), (1000, 2000), (9000, 300)], ids=str)
def test_large_photographs_are_reduced_to_the_size_that_points_take(
    size: tuple[int, int], run_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from deepdetect.detector import point_detector

    seen = []

    def none(gray: np.ndarray, *_: Any, **__: Any) -> Keypoints:
        seen.append(gray.shape[::-1])
        return Keypoints(np.empty((0, 2)), [], gray.shape[::-1], sizes=[])

    monkeypatch.setattr(point_detector, "detect_points", none)
    rgb = np.zeros((size[1], size[0], 3), np.uint8)
    deepdetect.PointDetector(5).detect(rgb)
    found = run_node(
        'import { pointsSize } from "@/pixels.js";\n',
        WRITE + "write(pointsSize(width, height));\n",
        np.zeros(1),
        width=size[0],
        height=size[1],
    )
    assert found.tolist() == list(seen[0])
