"""All 116 scenes and the usual 108, each under its name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetect
from deepdetect.datasets.hpatches import in_d2net_subset
from deepdetect.datasets.types import PlanarScene
from deepdetect.evaluation.protocols import BenchmarkOptions, hpatches
from deepdetect.evaluation.workspace import Workspace

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


def test_the_usual_scenes_are_108(every: list[PlanarScene]) -> None:
    assert [one.name for one in every if not in_d2net_subset(one)] == list(LARGE)
    sets = dict(hpatches._sets(every))
    assert {name: len(chosen) for name, chosen in sets.items()} == {
        "all 116 scenes": 116,
        "the usual 108 scenes": 108,
    }
    assert not {one.name for one in sets["the usual 108 scenes"]} & set(LARGE)


def test_both_sets_are_labelled_sections(
    every: list[PlanarScene], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    judged = []

    def sections(workspace, options, scenes, key, title, text):  # type: ignore[no-untyped-def]
        judged.append((len(scenes), key, title))
        return []

    monkeypatch.setattr(hpatches, "load_hpatches", lambda folder: every)
    monkeypatch.setattr(hpatches, "standard_sections", sections)
    options = BenchmarkOptions(DeepDetect(), ("standard",), ())
    hpatches.hpatches_sections(Workspace(tmp_path), options)
    assert judged == [
        (116, "hpatches_116", "HPatches, all 116 scenes"),
        (108, "hpatches_108", "HPatches, the usual 108 scenes"),
    ]
    steps = hpatches.hpatches_steps(Workspace(tmp_path), options)
    assert steps == len(options.standard_methods()) * 5 * (116 + 108)


def test_few_scenes_are_said_to_be_few() -> None:
    sets = dict(hpatches._sets([scene("v_dogman"), scene("i_pool")]))
    assert list(sets) == ["all 2 scenes"]
