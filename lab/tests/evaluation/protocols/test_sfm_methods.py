"""Keypoints and matches of each method, on small photographs of the fountain."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from deepdetect import Keypoints, PointDetector
from deepdetect.sfm.stages import MultiViewOptions, Stages
from deepdetect_lab.datasets.posed_images import PosedPair, load_posed_scenes
from deepdetect_lab.evaluation.metrics.pose import epipolar_inlier_ratio
from deepdetect_lab.evaluation.protocols.sfm import (
    find_points,
    find_random_points,
    find_sift,
    match_sift,
)

NAMES = ("0004", "0005", "0006")
MAX_KEYPOINTS = 800


@pytest.fixture(scope="module")
def scene(write_posed_fountain, tmp_path_factory):
    folder = write_posed_fountain(tmp_path_factory.mktemp("scene") / "fountain", NAMES)
    (found,) = load_posed_scenes(folder)
    return found


def stages_in(folder: Path, scene, count: int = 3) -> tuple[Stages, Path]:
    stages = Stages(folder, MultiViewOptions(), 1, True)
    return stages, stages.folder_of([image.path for image in scene.images[:count]])


def keypoints_of(stages: Stages) -> dict[str, dict[str, np.ndarray]]:
    import h5py

    with h5py.File(stages.features) as file:
        return {name: {kind: file[name][kind][()] for kind in file[name]} for name in file}


def agreement(scene, stages: Stages, matches) -> list[float]:
    """Return the fraction of the matches of each pair that agree with the true cameras."""
    found = keypoints_of(stages)
    images = {image.path.name: image for image in scene.images}
    ratios = []
    for (first, second), rows in matches.items():
        pair = PosedPair("fountain", images[first], images[second])
        xy = [found[n]["keypoints"][rows[:, k]] for k, n in enumerate((first, second))]
        ratios.append(epipolar_inlier_ratio(*xy, pair.fundamental))
    return ratios


def test_random_points_differ_from_ours_in_nothing_but_their_places(scene, tmp_path: Path) -> None:
    ours, folder = stages_in(tmp_path / "ours", scene, 2)
    find_points(PointDetector(8192), ours, folder)
    shutil.copytree(tmp_path / "ours", tmp_path / "random", symlinks=True)  # found only once
    random, folder = stages_in(tmp_path / "random", scene, 2)
    find_random_points(PointDetector(8192), random, folder)
    both = keypoints_of(ours), keypoints_of(random)
    pair = "0004.jpg", "0005.jpg"
    assert set(both[0]) == set(both[1]) == set(pair)
    for name, own in both[0].items():
        its = both[1][name]
        assert {k: v.shape for k, v in its.items()} == {k: v.shape for k, v in own.items()}
        np.testing.assert_array_equal(np.sort(its["scales"]), np.sort(own["scales"]))
        size = its["image_size"]
        # Uniform: each quarter of the image has about as many.
        counts = np.histogram2d(*its["keypoints"].T, 2, [[0, size[0] - 1], [0, size[1] - 1]])[0]
        np.testing.assert_allclose(counts, len(own["keypoints"]) / 4, rtol=0.25)
        values = {"sizes": 2 * its["scales"], "angles": its["oris"]}
        points = Keypoints(its["keypoints"], its["scores"], tuple(map(int, size)), **values)
        expected = PointDetector(8192).describe(folder / name, points).descriptors
        expected = expected / np.linalg.norm(expected.astype(np.float32), axis=1, keepdims=True)
        np.testing.assert_allclose(its["descriptors"].T, expected, atol=1e-5)
    first, second = (both[1][name]["keypoints"] for name in pair)
    assert np.abs(first[:100] - second[:100]).max() > 10  # other places in each photograph
    true, chance = (agreement(scene, stages, stages.match([pair]))[0] for stages in (ours, random))
    assert true > chance


def test_sift_is_matched_by_its_own_matcher(scene, tmp_path: Path) -> None:
    stages, folder = stages_in(tmp_path / "sift", scene)
    find_sift(stages, folder)
    found = keypoints_of(stages)
    for values in found.values():
        assert values["image_size"].tolist() == [384, 256]
        assert 200 < len(values["keypoints"]) <= 1.5 * MAX_KEYPOINTS  # some at two angles
        assert (values["keypoints"] > -0.5).all()
    pairs = [("0005.jpg", "0004.jpg"), ("0005.jpg", "0006.jpg"), ("0004.jpg", "0006.jpg")]
    matches = match_sift(stages, pairs)
    assert list(matches) == pairs  # also the other way round
    assert min(len(rows) for rows in matches.values()) > 50
    assert min(agreement(scene, stages, matches)) > 0.85
