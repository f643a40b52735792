"""All 116 scenes and the usual 108, each under its name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetect
from deepdetect.datasets.hpatches import in_d2net_subset
from deepdetect.datasets.pair_selection import PairSelectionOptions
from deepdetect.datasets.types import PlanarScene
from deepdetect.evaluation import planar_benchmarks
from deepdetect.evaluation.context import BenchmarkContext
from deepdetect.evaluation.options import BenchmarkOptions
from deepdetect.evaluation.planar_benchmarks import (
    _table_3,
    hpatches_subsets,
    plan_hpatches,
    plan_oxford,
    select_pairs,
)
from deepdetect.evaluation.report import Column, Table

LARGE = (
    *("i_contruction", "i_crownnight", "i_dc", "i_pencils", "i_whitebuilding"),
    *("v_artisans", "v_astronautis", "v_talent"),
)
"""Scenes with images that D2-Net's authors left out, and nearly all papers since."""


def scene(name: str) -> PlanarScene:
    images = tuple(Path(f"{name}/{number}.ppm") for number in range(1, 7))
    return PlanarScene(name, images, tuple(np.eye(3) for _ in range(5)))


@pytest.fixture
def every() -> list[PlanarScene]:
    others = [f"i_other{n}" for n in range(52)] + [f"v_other{n}" for n in range(56)]
    return [scene(name) for name in (*LARGE, *others)]


def test_the_d2_net_subset_has_108_scenes(every: list[PlanarScene]) -> None:
    assert [one.name for one in every if not in_d2net_subset(one)] == list(LARGE)
    sets = dict(hpatches_subsets(every))
    assert {name: len(chosen) for name, chosen in sets.items()} == {
        "all 116 scenes": 116,
        "the 108 scenes of D2-Net": 108,
    }
    assert not {one.name for one in sets["the 108 scenes of D2-Net"]} & set(LARGE)


def test_both_sets_are_labelled_sections(
    every: list[PlanarScene], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(planar_benchmarks, "load_hpatches", lambda folder: every)
    options = BenchmarkOptions(DeepDetect(), ("standard",), ())
    plans = plan_hpatches(BenchmarkContext(tmp_path), options)
    assert [plan.title for plan in plans] == [
        "HPatches, all 116 scenes, the standard protocol",
        "HPatches, the 108 scenes of D2-Net, the standard protocol",
    ]
    methods = len(options.standard_features())
    assert [len(plan) for plan in plans] == [methods * 5 * 116, methods * 5 * 108]


def test_few_scenes_are_said_to_be_few() -> None:
    sets = dict(hpatches_subsets([scene("v_dogman"), scene("i_pool")]))
    assert list(sets) == ["all 2 scenes"]


def test_table_3_averages_by_kind_of_scene_and_says_how_many() -> None:
    title = "DeepDetect, threshold 0.5"
    columns = tuple(Column(name, ".4f") for name in ("method", "mean", "i_a", "v_a", "i_b"))
    rows = ((title, 0.5, 0.25, 0.9, 0.75), ("SIFT", 0, 0.5, None, 0.5))
    found = _table_3(Table("key", "", columns, rows), [True, False, True])
    assert [column.title for column in found.columns[1:]] == [
        "illumination, 2 scenes",
        "viewpoint, 1 scenes",
    ]
    assert found.rows[:3] == (
        (title, 0.5, 0.9),
        (f"{title}, in the paper", 0.896, 0.901),
        ("SIFT", 0.5, None),
    )
    assert "illumination, 2 scenes 0.5000 (0.8960); the paper's are of 57 and 59" in found.note


def test_a_small_oxford_is_measured_and_what_it_lacks_is_said(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(
        planar_benchmarks, "load_oxford", lambda *_: [scene("graf"), scene("leuven")]
    )
    for name in ("graf", "leuven"):
        (tmp_path / name).mkdir()
        for number in range(2, 7):
            (tmp_path / name / f"H1to{number}p").touch()
    (tmp_path / "graf" / "H1to6p.refined").touch()
    options = BenchmarkOptions(
        DeepDetect(), ("standard", "guided"), (), pair_selection=PairSelectionOptions(1)
    )
    context = BenchmarkContext(tmp_path)
    plans = plan_oxford(context, options)
    methods = len(options.standard_features())
    assert [(plan.title, len(plan)) for plan in plans[:2]] == [
        ("Oxford, published homographies, the standard protocol", 2 * methods),
        ("Oxford, refined homographies, the standard protocol", 2 * methods),
    ]
    assert context.skipped[0].startswith("Oxford's bark, bikes, boat, trees, ubc, wall: not in")
    assert context.skipped[1].startswith("refined homographies of leuven 1-6: there is no file")
    chosen = select_pairs([scene("graf").with_max_pairs(2)], [("graf", 6), ("graf", 4)])
    assert [pair.name for pair in chosen] == ["graf 1-6"]
