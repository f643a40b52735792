from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetect
from deepdetect.features.keypoints import Keypoints
from deepdetect_lab.datasets.planar import PlanarPair, load_low_visibility
from deepdetect_lab.evaluation.baselines.method import (
    BaselineError,
    LocalFeature,
    with_common_descriptor,
)
from deepdetect_lab.evaluation.baselines.opencv import CLASSICAL
from deepdetect_lab.evaluation.benchmarks import run_benchmarks
from deepdetect_lab.evaluation.metrics import repeatability
from deepdetect_lab.evaluation.metrics.repeatability import mutual_nn_repeatability
from deepdetect_lab.evaluation.options import BenchmarkOptions
from deepdetect_lab.evaluation.protocols import standard
from deepdetect_lab.evaluation.protocols.standard import (
    pair_row,
    repeated,
    standard_rows,
    standard_tables,
)
from deepdetect_lab.evaluation.report import Report, Rows, where
from deepdetect_lab.evaluation.run import Run

FAST = with_common_descriptor(CLASSICAL["fast"])


@pytest.fixture(scope="module")
def pairs(low_visibility_folder: Path) -> list[PlanarPair]:
    return [pair for s in load_low_visibility(low_visibility_folder) for pair in s.pairs]


@pytest.fixture(scope="module", autouse=True)
def few_random_points():
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(repeatability, "CHANCE_POINTS", 200)
        yield


def table_of(feature: LocalFeature, rows: Rows, key: str) -> dict[str, object]:
    """Return the line of a table by column."""
    (table,) = [
        t for t in standard_tables([feature], rows, "key", "pairs") if t.key == f"key_{key}"
    ]
    return table.rows[0]


def test_budgets_and_repeatability_are_those_of_the_best_points(
    pairs: list[PlanarPair], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(standard, "BUDGETS", (64, None))
    run = Run(tmp_path, tmp_path / "cache")
    method = with_common_descriptor(CLASSICAL["fast-low"])
    for pair in pairs:
        row = pair_row(run, method, pair)
        for budget in (64, None):
            points = []
            for path in (pair.first, pair.second):
                keypoints, _ = run.keypoints(method, path)
                assert len(np.unique(keypoints.xy, axis=0)) == len(keypoints)
                points.append(keypoints.best(budget or len(keypoints)).xy)
            found = mutual_nn_repeatability(*points, np.eye(3), ((80, 64), (80, 64)))
            for radius, values in zip((1.0, 2.0, 3.0), found, strict=True):
                names = "repeated", "chance", "localization"
                kept = [row[name, budget, radius] for name in names]
                assert kept == pytest.approx(values, nan_ok=True)
        assert row["keypoints", 64] == 64


def test_of_equal_images_all_is_repeated_and_the_homography_exact(
    pairs: list[PlanarPair], tmp_path: Path
) -> None:
    rows = standard_rows(Run(tmp_path), [FAST], pairs[:1])
    (row,) = rows
    for radius in (1.0, 2.0, 3.0):
        assert row["repeated", 512, radius] == 1
        assert row["localization", 512, radius] == 0
    assert row["matches"] == row["correct", 1] > 10
    assert len(row["corner errors"]) == 5
    assert max(row["corner errors"]) < 1e-3
    matching, homography = (table_of(FAST, rows, key) for key in ("matching", "homography"))
    assert matching["precision at 1 px"] == homography["accuracy at 1 px"] == 1
    assert homography["AUC at 3 px"] == pytest.approx(1, abs=1e-3)
    assert homography["± of AUC 3"] == pytest.approx(0, abs=1e-3)


def test_learned_descriptors_are_matched_without_a_ratio_test(
    pairs: list[PlanarPair], tmp_path: Path
) -> None:
    method = with_common_descriptor(CLASSICAL["fast-low"])
    tested, untested = (
        pair_row(Run(tmp_path), dataclasses.replace(method, learned=learned), pairs[1])
        for learned in (False, True)
    )
    assert untested["matches"] > tested["matches"]


def test_kinds_of_pairs_have_their_own_means(pairs: list[PlanarPair], tmp_path: Path) -> None:
    kinds = "still", "darker"
    chosen = [dataclasses.replace(p, kind=k) for p, k in zip(pairs, kinds, strict=True)]
    rows = standard_rows(Run(tmp_path), [FAST], chosen)
    of_kinds = table_of(FAST, rows, "kinds")
    for kind, row in zip(kinds, rows, strict=True):
        # The budget of the table is not filled by these small images.
        assert of_kinds[f"{kind}: @1 px"] is of_kinds[f"{kind}: @3 px"] is None
        assert of_kinds[f"{kind}: correct"] == row["correct", 1]
    darker = where(rows, kind="darker")
    assert repeated(darker, None, 1.0) == rows[1]["repeated", None, 1.0]
    assert repeated(rows, 2048, 1.0) is None


def test_a_pair_without_keypoints_counts_as_wrong_and_is_no_error(
    pairs: list[PlanarPair], tmp_path: Path
) -> None:
    def nothing(rgb: np.ndarray) -> Keypoints:
        return Keypoints.empty((rgb.shape[1], rgb.shape[0]))

    method = dataclasses.replace(FAST, detect=nothing, detection="nothing")
    rows = standard_rows(Run(tmp_path), [method], pairs)
    assert [row["matches"] for row in rows] == [0, 0]
    assert {error for row in rows for error in row["corner errors"]} == {math.inf}
    assert set(list(table_of(method, rows, "matching").values())[2:]) == {0}
    assert set(list(table_of(method, rows, "homography").values())[2:]) == {0}
    assert math.isnan(rows[0]["localization", 512, 1.0])


@pytest.fixture(scope="module")
def report(low_visibility_folder: Path, edge_detector: DeepDetect, tmp_path_factory) -> Report:
    def fail(rgb: np.ndarray) -> Keypoints:
        raise BaselineError("never")

    never = LocalFeature("never", "Never works", fail, CLASSICAL["fast"].describe)
    options = BenchmarkOptions(edge_detector, ("standard",), ("fast",), (never,))
    cache = tmp_path_factory.mktemp("cache")
    return run_benchmarks(["low-visibility"], low_visibility_folder, options, cache=cache)


def test_baselines_are_worth_what_chance_is(report: Report) -> None:
    rows = {row["method"]: row for row in report.tables()[0].rows}
    every = rows["baseline: all pixels (a grid, where there is a budget)"]
    assert every["all"] == 1
    assert every["all: chance"] == 1
    assert every["all: chance-corrected"] is None, "nothing can be distinguished from chance"
    assert every["keypoints of all"] == 80 * 64
    # Of smoky's two images the random points differ; dusty's are one image twice.
    own = rows["DeepDetect, pixels by logits, suppression 3x3, sub-pixel"]
    assert own["512: chance-corrected"] is None or own["512: chance-corrected"] > 0.3
    assert own["all"] > own["all: chance"]
