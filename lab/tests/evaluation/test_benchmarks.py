"""The paper's protocol on eight small scenes, beside counts that are made without this package."""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from deepdetect import DeepDetect, ImageError, OptionError
from deepdetect.features.keypoints import Keypoints
from deepdetect_lab.evaluation import benchmarks
from deepdetect_lab.evaluation.baselines.method import LocalFeature
from deepdetect_lab.evaluation.baselines.opencv import CLASSICAL
from deepdetect_lab.evaluation.benchmarks import BENCHMARKS, run_benchmarks
from deepdetect_lab.evaluation.metrics import repeatability
from deepdetect_lab.evaluation.options import DEFAULT_PROTOCOLS, BenchmarkOptions
from deepdetect_lab.evaluation.protocols import degraded
from deepdetect_lab.evaluation.report import Report

MADE = "results computed, not read from the cache"
SCENES = ("bark", "bikes", "boat", "graf", "leuven", "trees", "ubc", "wall")
PAIRS = ("graf 1-6", "wall 1-6", "bikes 1-6", "leuven 1-6", "trees 1-6", "ubc 1-6", "boat 1-2")


def gray(path: Path) -> np.ndarray:
    return cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2GRAY)


def broken_feature(error: Exception) -> LocalFeature:
    def detect(rgb: np.ndarray) -> Keypoints:
        raise error

    return LocalFeature("broken", "Broken", detect, CLASSICAL["fast"].describe)


@dataclass
class Runs:
    """One cache, filled by one run after the other."""

    first: Report
    more: Report


@pytest.fixture(scope="module")
def options(edge_detector: DeepDetect) -> BenchmarkOptions:
    return BenchmarkOptions(edge_detector, ("paper",), ("fast", "orb-low"))


@pytest.fixture(scope="module")
def more_options(options: BenchmarkOptions) -> BenchmarkOptions:
    return dataclasses.replace(options, others=(CLASSICAL["orb"],))


@pytest.fixture(scope="module")
def runs(
    oxford_folder: Path,
    options: BenchmarkOptions,
    more_options: BenchmarkOptions,
    tmp_path_factory: pytest.TempPathFactory,
) -> Runs:
    cache = tmp_path_factory.mktemp("cache")
    chosen = (options, more_options)
    return Runs(*(run_benchmarks(["oxford"], oxford_folder, one, cache=cache) for one in chosen))


def table(report: Report, key: str) -> dict[str, dict[str, object]]:
    """Return a table as rows by title, of cells by column."""
    (found,) = [table for table in report.tables() if table.key == key]
    return {row["method"]: row for row in found.values()}


def images(folder: Path, scene: str) -> list[Path]:
    return [folder / "oxford" / scene / f"img{number}.png" for number in range(1, 7)]


def read_matrix(folder: Path, scene: str, number: int) -> np.ndarray:
    return np.loadtxt(folder / "oxford" / scene / f"H1to{number}p")


def moved(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    return cv2.perspectiveTransform(points[None].astype(np.float64), matrix)[0]


ALL_PIXELS = "baseline: all pixels (a grid, where there is a budget)"


def test_density_equals_opencvs_count_over_the_pixels(runs: Runs, oxford_folder: Path) -> None:
    row = table(runs.first, "oxford_density")["FAST"]
    every = []
    for scene in SCENES:
        values = []
        for path in images(oxford_folder, scene):
            picture = gray(path)
            found = cv2.FastFeatureDetector_create().detect(picture, None)
            values.append(len(found) / picture.size)
        assert row[scene] == pytest.approx(np.mean(values), abs=1e-12)
        every += values
    assert row["mean"] == pytest.approx(np.mean(every), abs=1e-12)
    everything = table(runs.first, "oxford_density")[ALL_PIXELS]
    assert {everything[name] for name in ("mean", *SCENES)} == {1}


def test_repeatability_equals_a_search_by_trees(runs: Runs, oxford_folder: Path) -> None:
    row = table(runs.first, "oxford_repeatability")["FAST"]
    for scene in SCENES:
        points = [
            np.array(
                [p.pt for p in cv2.FastFeatureDetector_create().detect(gray(path), None)]
            ).reshape(-1, 2)
            for path in images(oxford_folder, scene)
        ]
        values = []
        for number in range(2, 7):
            fewest = min(len(points[0]), len(points[number - 1]))
            if not fewest:
                values.append(0.0)
                continue
            mapped = moved(points[0], read_matrix(oxford_folder, scene, number))
            distance, _ = KDTree(points[number - 1]).query(mapped)
            values.append(min((distance < 1).sum() / fewest, 1))
        assert row[scene] == pytest.approx(np.mean(values), abs=1e-9), scene
    assert row["mean"] == pytest.approx(np.mean([row[scene] for scene in SCENES]))


@pytest.mark.parametrize("title", ["ORB, low settings", "ORB"])
def test_correct_matches_equal_a_count_of_all_bits(
    runs: Runs, oxford_folder: Path, title: str
) -> None:
    row = table(runs.more, "oxford_matches")[title]
    detector = cv2.ORB_create(1_000_000, fastThreshold=1) if "low" in title else cv2.ORB_create()
    first, second = images(oxford_folder, "boat")[:2]
    points, bits = [], []
    for path in (first, second):
        keypoints = detector.detect(gray(path), None)
        keypoints, described = cv2.ORB_create().compute(gray(path), keypoints)
        points.append(np.array([p.pt for p in keypoints]))
        bits.append(np.unpackbits(described, axis=1).astype(float))
    every = cdist(*bits, "cityblock")
    ordered = np.sort(every, axis=1)
    kept = ordered[:, 0] < 0.99 * ordered[:, 1]
    mapped = moved(points[0][kept], read_matrix(oxford_folder, "boat", 2))
    errors = np.linalg.norm(mapped - points[1][every.argmin(1)[kept]], axis=1)
    correct = int((errors < 1).sum())
    assert correct > 5
    assert row["boat 1-2"] == correct
    assert row["boat 1-2, precision"] == pytest.approx(correct / kept.sum())
    # The other scenes are too small for ORB: no matches, and no precision.
    assert row["graf 1-6"] == 0
    assert row["graf 1-6, precision"] is None


def test_one_more_method_makes_only_its_own_results(runs: Runs, oxford_folder: Path) -> None:
    def digest(path: Path) -> str:
        return hashlib.sha256(path.read_bytes()).hexdigest()

    files = {scene: [digest(path) for path in images(oxford_folder, scene)] for scene in SCENES}
    keypoints = {name for scene in SCENES for name in files[scene]}
    repeatability = {
        (files[scene][0], files[scene][k - 1], read_matrix(oxford_folder, scene, k).tobytes())
        for scene in SCENES
        for k in range(2, 7)
    }
    expected = len(keypoints) + len(repeatability) + len(PAIRS)
    assert int(runs.more.metadata[MADE]) == expected < int(runs.first.metadata[MADE])
    # What was there before is as it was.
    for key in ("oxford_density", "oxford_repeatability", "oxford_matches"):
        before, after = table(runs.first, key), table(runs.more, key)
        assert after.pop("ORB")
        assert before == after


@pytest.mark.parametrize("error", [ZeroDivisionError("a bug"), OptionError("a bug")])
def test_a_bug_of_ours_ends_the_run(
    low_visibility_folder: Path, options: BenchmarkOptions, error: Exception
) -> None:
    buggy = dataclasses.replace(options, others=(broken_feature(error),))
    with pytest.raises(type(error), match="a bug"):
        run_benchmarks(["low-visibility"], low_visibility_folder, buggy)


@pytest.mark.slow
def test_hpatches_has_the_tables_of_all_protocols(
    options: BenchmarkOptions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write_scene
) -> None:
    monkeypatch.setattr(repeatability, "CHANCE_POINTS", 200)
    for scene in ("i_dc", "v_small"):
        write_scene(tmp_path / "hpatches" / scene, (24, 20), np.eye(3), ("{}.ppm", "H_1_{}"))
    protocols = (*DEFAULT_PROTOCOLS, "degraded")
    all_protocols = dataclasses.replace(options, protocols=protocols, classical=())
    report = run_benchmarks(["hpatches"], tmp_path, all_protocols)
    keys = [table.key for table in report.tables()]
    assert len(set(keys)) == len(keys) > 10
    rows = table(report, "hpatches_table3")
    assert list(rows[ALL_PIXELS]) == ["method", "illumination, 1 scenes", "viewpoint, 1 scenes"]
    assert rows[ALL_PIXELS]["viewpoint, 1 scenes"] == 1


def test_unknown_names_and_missing_data_are_said(tmp_path: Path, options: BenchmarkOptions) -> None:
    with pytest.raises(OptionError, match="'oxford'"):
        run_benchmarks(["oxfrod"], tmp_path, options)
    for name in BENCHMARKS:
        with pytest.raises(ImageError) as missing:
            run_benchmarks([name], tmp_path, options)
        assert str(tmp_path) in str(missing.value)


def test_missing_data_stop_only_the_benchmark_that_needs_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, edge_detector: DeepDetect
) -> None:
    def lacks(run: object, options: object) -> list:
        raise ImageError("this needs photographs")

    known = {"one": ("degraded", "lacks"), "other": ("degraded", "works")}
    monkeypatch.setattr(benchmarks, "BENCHMARKS", known)
    monkeypatch.setattr(degraded, "lacks", lacks, raising=False)
    monkeypatch.setattr(degraded, "works", lambda *_: [], raising=False)
    options = BenchmarkOptions(edge_detector, ("paper", "guided"))
    report = run_benchmarks(["one", "other"], tmp_path, options)
    notes = (
        "the benchmark one: this needs photographs",
        "other: it has no protocol paper or guided",
    )
    assert (report.failures, report.skipped) == (notes[:1], notes)
    with pytest.raises(ImageError):
        run_benchmarks(["one"], tmp_path, options)
