"""Dark and blurred copies of a small scene, in the tables of the standard protocol."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetect
from deepdetect.io.image import load_image
from deepdetect_lab.datasets.degradation import DEGRADATIONS, degrade
from deepdetect_lab.datasets.planar import PlanarPair, load_low_visibility
from deepdetect_lab.evaluation.baselines.method import with_common_descriptor
from deepdetect_lab.evaluation.baselines.opencv import STANDARD
from deepdetect_lab.evaluation.metrics import repeatability
from deepdetect_lab.evaluation.options import BenchmarkOptions
from deepdetect_lab.evaluation.protocols import degraded
from deepdetect_lab.evaluation.protocols.degraded import degraded_pair, degraded_sections
from deepdetect_lab.evaluation.protocols.standard import pair_row
from deepdetect_lab.evaluation.run import Run


@pytest.fixture(scope="module")
def pairs(low_visibility_folder: Path) -> list[PlanarPair]:
    return [pair for s in load_low_visibility(low_visibility_folder) for pair in s.pairs]


def test_a_copy_is_made_once_and_outside_the_data(pairs: list[PlanarPair], tmp_path: Path) -> None:
    image, one = pairs[0].second, DEGRADATIONS["dark-8"]
    before = sorted(image.parent.iterdir())
    pair = degraded_pair(pairs[0], one, tmp_path)
    path = pair.second
    assert path.is_relative_to(tmp_path)
    assert sorted(image.parent.iterdir()) == before
    np.testing.assert_array_equal(load_image(path), degrade(load_image(image), one))
    made = path.stat().st_mtime_ns
    assert degraded_pair(pairs[0], one, tmp_path).second == path
    assert path.stat().st_mtime_ns == made
    newer = degraded_pair(pairs[0], dataclasses.replace(one, version=2), tmp_path)
    assert newer.second != path
    assert pair.first == pairs[0].first
    assert pair.homography is pairs[0].homography


def test_each_degradation_has_the_tables_of_the_standard_protocol(
    pairs: list[PlanarPair],
    tmp_path: Path,
    edge_detector: DeepDetect,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(repeatability, "CHANCE_POINTS", 200)
    monkeypatch.setattr(degraded, "DEGRADATIONS", {"dark-8": DEGRADATIONS["dark-8"]})
    run = Run(tmp_path, tmp_path / "cache")
    options = BenchmarkOptions(edge_detector, ("degraded",), classical=("fast",))
    lost = dataclasses.replace(pairs[1], second=tmp_path / "nothing.png", number=3)
    (section,) = degraded_sections(run, options, [*pairs, lost], "key", "Pairs")
    assert section.title == "Pairs, 1/8 of the light, the standard protocol"
    table = section.tables[0]
    assert table.key == "key_dark-8_repeatability_1px"
    row = next(row for row in table.rows if row["method"] == "FAST")
    feature = with_common_descriptor(STANDARD["fast"])
    dark = [degraded_pair(pair, DEGRADATIONS["dark-8"], run.files_folder) for pair in pairs]
    made = run.made
    repeated = [pair_row(run, feature, pair)["repeated", None, 1.0] for pair in dark]
    assert row["all"] == pytest.approx(np.mean(repeated))
    assert run.made == made, "all of it is cached"
    assert len(run.failures) == 1
    plain = BenchmarkOptions(edge_detector, ("standard",))
    assert degraded_sections(run, plain, pairs, "key", "Pairs") == []
