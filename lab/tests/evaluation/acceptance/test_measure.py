"""Tests of judging answers to pairs with a known geometry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from skimage import data

from deepdetect import Keypoints, Matches
from deepdetect._shared.errors import ImageError
from deepdetect.features.matches import TwoViewGeometry
from deepdetect.geometry.transforms import translation_matrix
from deepdetect_lab.evaluation.acceptance import measure as acceptance
from deepdetect_lab.evaluation.acceptance import synthetic
from deepdetect_lab.evaluation.acceptance.pairs import ROWS, UNRELATED, JudgedPair, Truth

RNG = np.random.default_rng(0)
PLACES = RNG.uniform(0, 90, (40, 2))


def matches(points0: np.ndarray, points1: np.ndarray, scene: str = "planar") -> Matches:
    """Return matches with a geometry of high confidence."""
    geometry = TwoViewGeometry("homography", np.eye(3), scene=scene, confidence="high")
    scores = np.ones(len(points0), np.float32)
    keypoints = Keypoints(points0, scores, (100, 100)), Keypoints(points1, scores, (100, 100))
    return Matches(points0, points1, scores, scores > 0, *keypoints, geometry=geometry)


def test_judge_of_a_plane() -> None:
    mask = np.zeros((100, 100), bool)
    mask[:, :50] = True
    truth = Truth(translation_matrix(5, 0), mask)
    moved = matches(PLACES, PLACES + [5, 0])
    np.testing.assert_array_equal(
        truth.correct(moved.points0, moved.points1), np.rint(PLACES[:, 0]) < 50
    )
    left = PLACES[PLACES[:, 0] < 49]
    assert truth.judge(matches(left, left + [5, 0])) == "right"
    assert truth.judge(matches(left, left)) == "wrong"
    assert truth.judge(moved[:0]) == "lost"


def test_judge_of_depth() -> None:
    truth = Truth(fundamental=ROWS, depth=True)
    along_rows = PLACES, PLACES - np.column_stack([RNG.uniform(0, 20, 40), np.zeros(40)])
    assert truth.judge(matches(*along_rows, "depth with a dominant plane")) == "right"
    assert truth.judge(matches(*along_rows, "planar")) == "wrong"


def test_rows_of_an_engine_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blank = np.zeros((8, 8, 3), np.uint8)

    def family(_: Path) -> Any:
        yield JudgedPair("plane", "0", lambda: (blank, blank), Truth(np.eye(3)))
        yield JudgedPair("nothing", "0", lambda: (blank, blank), UNRELATED)

    asked: list[int] = []

    def engine(image0: np.ndarray, image1: np.ndarray, seed: int) -> Matches:
        asked.append(seed)
        return matches(PLACES, PLACES + [0, 9 * seed])

    monkeypatch.setitem(acceptance.FAMILIES, "made", family)
    log = tmp_path / "answers.jsonl"
    rows = acceptance.measure(tmp_path, engine, log, families=["made"], seeds=2)
    assert acceptance.measure(tmp_path, engine, log, families=["made"], seeds=2) == rows
    assert asked == [0, 1, 0, 1]
    lines = {line["kind"]: line for line in acceptance.summary(rows).values()}
    assert (lines["plane"]["right"], lines["plane"]["wrong, high"]) == (1, 1)
    assert (lines["nothing"]["right"], lines["nothing"]["wrong, high"]) == (0, 2)
    with pytest.raises(ImageError):
        acceptance.measure(tmp_path, engine, log, families=["oxford"])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    from PIL import Image

    names = {"oxford/graf/img1.png": data.astronaut(), "foreground/a.jpg": data.coffee()}
    names |= {"foreground/b.jpg": data.chelsea()}
    for side, view in zip(("left", "right"), data.stereo_motorcycle()[:2], strict=True):
        names[f"middlebury/motorcycle/{side}.png"] = view
    for name, image in names.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(tmp_path / name)
    return tmp_path


@pytest.mark.parametrize("name", ["planes", "facades", "hard_views"])
def test_truth_of_synthetic_planes(
    folder: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Content of the first view is where the homography says in the second one."""
    import cv2

    for number in ("PLANES", "FACADES", "HARD"):
        monkeypatch.setattr(synthetic, number, 3)
    for pair in getattr(synthetic, name)(folder):
        first, second = (cv2.cvtColor(view, cv2.COLOR_RGB2GRAY) for view in pair.make())
        back = np.linalg.inv(pair.truth.homography)
        seen = cv2.warpPerspective(second, back, first.shape[::-1])
        shown = cv2.warpPerspective(np.ones_like(second), back, first.shape[::-1]) > 0
        if pair.truth.plane is not None:
            shown &= pair.truth.plane
        shown = cv2.erode(shown.astype(np.uint8), np.ones((25, 25))) > 0
        if "between" in pair.kind:  # only the facade is shared, and its place is not told
            continue
        assert np.corrcoef(first[shown], seen[shown])[0, 1] > 0.7, pair.kind
