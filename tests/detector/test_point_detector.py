from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import skimage.data

from deepdetect import Keypoints, OptionError, PointDetector, WeightsError, match_features
from deepdetect.detector.points.detection import detect_points
from deepdetect.detector.points.ranker import load_ranker
from deepdetect.detector.pretrained import RANKER
from deepdetect.features.sift import scaled_sift_descriptors, to_root_sift

UPRIGHT_WARP = np.array([[0.95, 0.04, 5.0], [-0.02, 0.97, 6.0], [2e-4, 1e-4, 1.0]])


@pytest.fixture(scope="module")
def image(photo: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(photo[20:121, 60:197])


@pytest.fixture(scope="module")
def gray(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def test_it_finds_the_best_points(image: np.ndarray, gray: np.ndarray) -> None:
    for spread in ("none", "grid", "anms"):
        found = PointDetector(50.0, spread=spread).detect(image)
        np.testing.assert_array_equal(found.xy, detect_points(gray, 50, spread=spread).xy)
    assert len(PointDetector(None).detect(image)) == len(detect_points(gray))


def test_extracted_points_are_the_detected_ones_described(
    image: np.ndarray, gray: np.ndarray
) -> None:
    points = PointDetector(50, descriptor="rootsift")
    found, expected = points.extract(image), points.detect(image)
    np.testing.assert_array_equal(found.xy, expected.xy)
    sift = scaled_sift_descriptors(gray, expected.xy, expected.sizes, expected.angles)
    np.testing.assert_array_equal(found.descriptors, to_root_sift(sift))
    assert found.descriptor_type == "rootsift"


def test_a_ranker_of_ones_own_ranks(image: np.ndarray, tmp_path: Path) -> None:
    ranker = load_ranker()
    layers = [(np.zeros_like(weight), np.zeros_like(bias)) for weight, bias in ranker.layers]
    values = {f"weight{k}": weight for k, (weight, _) in enumerate(layers)}
    values |= {f"bias{k}": bias for k, (_, bias) in enumerate(layers)}
    path = tmp_path / "own.npz"
    np.savez(path, mean=ranker.mean, deviation=ranker.deviation, notes="{}", **values)
    own, bundled = PointDetector(40, ranker=path), PointDetector(40)
    found = own.detect(image)
    assert not np.array_equal(found.xy, bundled.detect(image).xy)
    # Nothing is added to the first feature: the logarithm of |det Hessian|.
    assert found.logits.max() <= 3
    other = pickle.loads(pickle.dumps(own))
    np.testing.assert_array_equal(other.detect(image).xy, found.xy)
    assert other.settings == own.settings != bundled.settings
    with pytest.raises(WeightsError, match=r"none\.npz"):
        PointDetector(ranker=tmp_path / "none.npz")


def test_points_of_large_images_are_found_on_two_megapixels(
    image: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "deepdetect.detector.point_detector.MAX_AUTO_PIXELS"
    monkeypatch.setattr(name, image[..., 0].size // 4)
    whole = PointDetector(200, resolution="native").detect(image)
    half = PointDetector(100).detect(image)
    assert half.image_size == whole.image_size
    gaps = np.linalg.norm(half.xy[:, None] - whole.xy, axis=2)
    assert np.mean(gaps.min(1) < 1.5) > 0.5
    assert half.sizes.min() > 1.8 * whole.sizes.min()
    ignore = np.zeros(image.shape[:2], bool)
    ignore[:, : image.shape[1] // 2] = True
    found = PointDetector(50).detect(image, ignore=ignore)
    assert found.xy[:, 0].min() > image.shape[1] // 2 - 2


@pytest.mark.parametrize(
    "options",
    [
        {"max_keypoints": 0},
        {"max_keypoints": 10, "spread": "greedy"},
        {"max_keypoints": None, "spread": "grid"},
        {"resolution": 480},
        {"threshold": 0.5},
        {"threads": 0},
    ],
)
def test_wrong_options_are_reported(options: dict[str, object]) -> None:
    with pytest.raises(OptionError):
        PointDetector(**options)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("precision", {"precision": "bfloat16"}),
        ("spread", {"spread": "anms", "backend": "onnxruntime"}),
        ("max_keypoints", {"max_keypoints": None, "backend": "onnxruntime"}),
        ("ranker", {"ranker": RANKER, "backend": "onnxruntime"}),
        ("device", {"device": "CUDAExecutionProvidr"}),
    ],
)
def test_what_points_have_not_is_refused_by_its_name(name: str, options: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=name):
        PointDetector(**options)


@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
def test_a_batch_by_a_graph_is_what_each_image_gives_alone(backend: str) -> None:
    pytest.importorskip(backend)
    photo = skimage.data.coffee()
    mask = np.zeros(photo.shape[:2], bool)
    mask[:, :300] = True
    images, masks = [photo, photo[::-1], photo[:301, :257], photo], [None, None, None, mask]
    by_graph = PointDetector(300, backend=backend).extract_batch(images, ignore=masks)
    for image, ignored, found in zip(images, masks, by_graph, strict=True):
        alone = PointDetector(300).extract(image, ignore=ignored)
        assert len(found) == len(alone) == 300
        gaps = np.linalg.norm(found.xy[:, None] - alone.xy, axis=2)
        gaps += np.abs(found.sizes[:, None] - alone.sizes)
        near, same = gaps.argmin(axis=1), gaps.min(axis=1) < 0.1
        # Masked candidates have ranks in the graph, which changes the order a little.
        assert same.mean() > (0.97 if ignored is None else 0.9)
        turns = (found.angles - alone.angles[near] + 180) % 360 - 180
        assert (np.abs(turns[same]) < 1).mean() > 0.97
        alike = (found.descriptors[same] * alone.descriptors[near][same]).sum(axis=1)
        assert np.median(alike) > 0.999
        if ignored is None:
            np.testing.assert_allclose(found.logits[same], alone.logits[near][same], atol=0.1)
        assert (np.diff(found.scores) < 0).all()


def test_a_batch_without_a_graph_is_what_each_image_gives_alone(image: np.ndarray) -> None:
    images = [image, image[:, ::-1], image[:50]]
    detector = PointDetector(50, descriptor="rootsift")
    for points in (PointDetector(50), detector):
        for one, found in zip(images, points.extract_batch(images), strict=True):
            alone = points.extract(one)
            np.testing.assert_array_equal(found.xy, alone.xy)
            np.testing.assert_array_equal(found.descriptors, alone.descriptors)


def test_images_of_a_batch_do_not_depend_on_each_other() -> None:
    photo = skimage.data.coffee()
    mask = np.zeros(photo.shape[:2], bool)
    mask[:, :560] = True
    detector = PointDetector(1500, backend="onnxruntime")
    together = detector.detect_batch([photo, photo], ignore=[None, mask])
    for found, ignored in zip(together, (None, mask), strict=True):
        np.testing.assert_array_equal(found.xy, detector.detect(photo, ignore=ignored).xy)


def test_records_tell_what_has_run(image: np.ndarray) -> None:
    own, graph = PointDetector(50), PointDetector(50, backend="onnxruntime")
    assert own.settings != graph.settings
    assert graph.runtime == "onnxruntime, cpu"
    assert graph.runtime in repr(graph)
    np.testing.assert_array_equal(
        pickle.loads(pickle.dumps(graph)).detect(image).xy, graph.detect(image).xy
    )
    with pytest.raises(OptionError, match=r"^the ignore mask"):
        own.extract(image, ignore=np.zeros((3, 3), bool))


def test_the_number_of_threads_changes_no_keypoint(image: np.ndarray) -> None:
    one, all_ = PointDetector(60, threads=1).extract(image), PointDetector(60).extract(image)
    np.testing.assert_array_equal(one.xy, all_.xy)
    np.testing.assert_array_equal(one.scores, all_.scores)
    np.testing.assert_allclose(one.descriptors, all_.descriptors, atol=1e-5)


def test_the_number_of_keypoints_is_that_of_the_call_or_else_of_the_detector(
    image: np.ndarray,
) -> None:
    points = PointDetector(40)
    best = points.detect(image)
    for find in (points.detect, points.extract):
        for asked, count in ((None, 40), (7, 7), (60, 60)):
            found = find(image, max_keypoints=asked)
            assert len(found) == count
            shared = min(count, 40)
            np.testing.assert_array_equal(found.xy[:shared], best.xy[:shared])
    found = points.detect_batch([image, image[:60]], max_keypoints=9)
    assert [len(each) for each in found] == [9, 9]
    assert len(pickle.loads(pickle.dumps(points)).detect(image)) == 40
    assert points.settings != PointDetector(41).settings
    with pytest.raises(OptionError, match="max_keypoints"):
        points.detect(image, max_keypoints=0)


class Shades:
    """A descriptor of somebody's own: the pixel below a keypoint and what surrounds it."""

    descriptor_type = "shades"

    def describe(self, image: np.ndarray, keypoints: Keypoints) -> Keypoints:
        padded = np.pad(image, ((3, 3), (3, 3), (0, 0)), mode="edge")
        x, y = np.rint(keypoints.xy).astype(int).T
        windows = np.lib.stride_tricks.sliding_window_view(padded, (7, 7), axis=(0, 1))
        values = windows[y, x].reshape(len(keypoints), -1).astype(np.float32)
        return replace(keypoints, descriptors=values, descriptor_type=self.descriptor_type)


def test_a_descriptor_of_ones_own_describes(image: np.ndarray) -> None:
    points = PointDetector(50, descriptor=Shades())
    assert points.descriptor_type == "shades"
    found = points.extract(image)
    np.testing.assert_array_equal(found.xy, PointDetector(50).detect(image).xy)
    assert (found.descriptors.shape, found.descriptor_type) == ((50, 147), "shades")
    matches = match_features(found, found)
    np.testing.assert_array_equal(matches.indices0, matches.indices1)
    assert len(matches) == 50
    again = pickle.loads(pickle.dumps(points)).extract(image)
    np.testing.assert_array_equal(again.descriptors, found.descriptors)


def test_upright_descriptors_keep_more_mutual_neighbours_of_upright_images(
    photo: np.ndarray,
) -> None:
    other = cv2.warpPerspective(photo, UPRIGHT_WARP, photo.shape[1::-1], flags=cv2.INTER_CUBIC)
    counts = []
    for upright in (False, True):
        points = PointDetector(500, upright=upright)
        first, second = points.extract(photo), points.extract(other)
        assert (first.angles == 0).all() == upright
        found = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(
            first.descriptors, second.descriptors
        )
        ends = cv2.perspectiveTransform(first.xy[None].astype(float), UPRIGHT_WARP)[0]
        errors = [np.linalg.norm(ends[m.queryIdx] - second.xy[m.trainIdx]) for m in found]
        counts.append(np.count_nonzero(np.array(errors) < 3))
    assert counts[1] > 1.05 * counts[0]


def test_a_least_logit_keeps_the_best_of_all(photo: np.ndarray) -> None:
    everything = PointDetector(None).detect(photo)
    least = float(np.median(everything.logits))
    found = PointDetector(None, min_logit=least).detect(photo)
    np.testing.assert_array_equal(found.xy, everything.xy[everything.logits >= least])
    assert len(PointDetector(10, min_logit=least).detect(photo)) == 10
    with pytest.raises(OptionError):
        PointDetector(min_logit="high")
