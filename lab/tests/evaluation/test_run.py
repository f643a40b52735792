from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.distance import cdist

from deepdetect import DeepDetectError, ImageError
from deepdetect.features.keypoints import Keypoints
from deepdetect.io.image import load_image
from deepdetect_lab.evaluation.baselines.method import LocalFeature
from deepdetect_lab.evaluation.baselines.opencv import CLASSICAL
from deepdetect_lab.evaluation.run import STAGES, CacheError, MatchSettings, Run

Pair = tuple[Path, Path]
FAST = CLASSICAL["fast"]


@pytest.fixture(scope="module")
def pair(photo: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Pair:
    """Two crops that are 6 and 4 pixels apart."""
    folder = tmp_path_factory.mktemp("pair")
    Image.fromarray(photo[50:150, 60:180]).save(folder / "first.png")
    Image.fromarray(photo[54:154, 66:186]).save(folder / "second.png")
    return folder / "first.png", folder / "second.png"


def counted(method: LocalFeature) -> tuple[LocalFeature, list[str]]:
    """Return the method, and what was asked of it."""
    asked: list[str] = []

    def detect(rgb: np.ndarray) -> Keypoints:
        asked.append("detect")
        return method.detect(rgb)

    def describe(rgb: np.ndarray, features: Keypoints) -> np.ndarray:
        asked.append("describe")
        return method.describe(rgb, features)

    return dataclasses.replace(method, detect=detect, describe=describe), asked


def points(*rows: tuple[float, float], **more: np.ndarray) -> LocalFeature:
    """Make a method that finds the same points everywhere."""

    def detect(rgb: np.ndarray) -> Keypoints:
        xy = np.array(rows, np.float32).reshape(-1, 2)
        return Keypoints(xy, np.linspace(1, 0, len(xy)), (rgb.shape[1], rgb.shape[0]), **more)

    return LocalFeature("points", "Points", detect, CLASSICAL["harris"].describe)


def assert_same(first: Keypoints, second: Keypoints) -> None:
    for name in ("xy", "scores", "logits", "sizes", "angles", "octaves", "descriptors"):
        one, other = getattr(first, name), getattr(second, name)
        if one is None:
            assert other is None
        else:
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)
    assert first.image_size == second.image_size


@pytest.mark.parametrize("name", ["orb", "shi-tomasi"])
def test_keypoints_from_the_cache_equal_fresh_ones(tmp_path: Path, pair: Pair, name: str) -> None:
    method, asked = counted(CLASSICAL[name])
    fresh = method.detect(load_image(pair[0]))
    made, found = (Run(tmp_path, tmp_path).keypoints(method, pair[0]) for _ in range(2))
    assert len(asked) == 2  # ours, and the first of the cache
    assert_same(made[0], fresh)
    assert_same(found[0], fresh)
    # The cost is that of the making, also when it is read.
    assert made[1] == found[1]
    assert made[1] > 0


def test_own_columns_come_back_from_the_cache(tmp_path: Path, pair: Pair) -> None:
    more = {
        "logits": np.array([17.5, 17.25], np.float32),
        "sizes": np.array([1.5, 2], np.float32),
        "angles": np.array([0.25, -1], np.float32),
        "octaves": np.array([-1, 16777215], np.int32),
        "descriptors": np.arange(6, dtype=np.uint8).reshape(2, 3),
    }
    method = points((1, 2), (3, 4), **more)
    for _ in range(2):
        found, _ = Run(tmp_path, tmp_path).keypoints(method, pair[0])
        assert_same(found, method.detect(load_image(pair[0])))


@pytest.mark.parametrize("name", ["orb", "fast"])
@pytest.mark.parametrize(
    "settings",
    [MatchSettings(), MatchSettings("exact", 0.85, mutual=True, budget=100)],
    ids=["paper", "standard"],
)
def test_matches_from_the_cache_equal_fresh_ones(
    tmp_path: Path, pair: Pair, name: str, settings: MatchSettings
) -> None:
    method, asked = counted(CLASSICAL[name])
    fresh = Run(tmp_path).matches(method, pair, settings)
    made = Run(tmp_path, tmp_path).matches(method, pair, settings)
    asked.clear()
    found = Run(tmp_path, tmp_path).matches(method, pair, settings)
    assert asked == []
    assert len(fresh.points0) > 20
    for part in ("points0", "points1", "keypoints0", "keypoints1"):
        np.testing.assert_array_equal(getattr(made, part), getattr(fresh, part))
        np.testing.assert_array_equal(getattr(found, part), getattr(fresh, part))
    assert found.seconds == made.seconds


def test_matches_by_euclid_equal_a_search_of_all_distances(pair: Pair) -> None:
    images = [load_image(path) for path in pair]
    method = CLASSICAL["sift"]
    features = [method.detect(rgb).best(60) for rgb in images]
    rows = [method.describe(*both) for both in zip(images, features, strict=True)]
    every = cdist(*[part.astype(float) for part in rows])
    ordered = np.sort(every, axis=1)
    kept = ordered[:, 0] < 0.85 * ordered[:, 1]
    kept &= every.argmin(0)[every.argmin(1)] == np.arange(len(every))
    found = Run(Path()).matches(method, pair, MatchSettings("exact", 0.85, mutual=True, budget=60))
    assert 10 < len(found.points0) < 60
    np.testing.assert_array_equal(found.points0, features[0].xy[kept])
    np.testing.assert_array_equal(found.points1, features[1].xy[every.argmin(1)[kept]])
    assert len(found.keypoints0) == len(found.keypoints1) == 60


Change = Callable[[LocalFeature], LocalFeature]


@pytest.mark.parametrize(
    ("change", "asked_again"),
    [
        (lambda m: dataclasses.replace(m, detection="", version="2"), ["describe", "detect"]),
        (lambda m: dataclasses.replace(m, version="2"), ["describe"]),
        (lambda m: dataclasses.replace(m, name="other"), ["describe"]),
        (lambda m: dataclasses.replace(m, title="Other"), []),
    ],
    ids=["version", "version of the descriptor", "name of the descriptor", "title"],
)
def test_another_version_is_not_served_and_shared_keypoints_are(
    tmp_path: Path, pair: Pair, change: Change, asked_again: list[str]
) -> None:
    method, asked = counted(FAST)
    Run(tmp_path, tmp_path).matches(method, pair, MatchSettings())
    asked.clear()
    Run(tmp_path, tmp_path).matches(change(method), pair, MatchSettings())
    assert sorted(set(asked)) == asked_again


def test_a_pair_is_described_once_for_all_settings(tmp_path: Path, pair: Pair) -> None:
    method, calls = counted(FAST)
    run = Run(tmp_path)
    found = [run.matches(method, pair, MatchSettings("exact", r)) for r in (0.8, 0.9, 1.0)]
    assert sorted(calls) == ["describe", "describe", "detect", "detect"]
    assert 0 < len(found[0].points0) < len(found[1].points0) < len(found[2].points0)
    back = run.matches(method, pair[::-1], MatchSettings("exact"))
    assert sorted(calls) == ["describe"] * 4 + ["detect"] * 2
    np.testing.assert_array_equal(found[0].keypoints0, back.keypoints1)


def test_another_image_under_the_same_name_is_detected_anew(
    tmp_path: Path, photo: np.ndarray
) -> None:
    path = tmp_path / "image.png"
    for left in (0, 60):
        Image.fromarray(photo[50:150, left : left + 100]).save(path)
        run = Run(tmp_path, tmp_path / "cache")
        found, _ = run.keypoints(FAST, path)
        assert_same(found, FAST.detect(photo[50:150, left : left + 100]))
        assert run.made == 1
    copy = tmp_path / "copy.png"
    copy.write_bytes(path.read_bytes())
    run.keypoints(FAST, copy)
    assert run.made == 1


@pytest.mark.parametrize("matcher", ["flann", "exact"])
@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_keypoints_are_no_error(pair: Pair, matcher: str, count: int) -> None:
    method = points(*[(20, 30), (60, 40)][:count])
    found = Run(Path()).matches(method, pair, MatchSettings(matcher))
    assert found.points0.shape == found.points1.shape
    assert len(found.keypoints0) == count
    assert count == 2 or len(found.points0) == 0


ROW = {"rows": np.arange(50, dtype=np.int16), "number": 3, "text": "three"}


def is_made(run: Run, stage: str, depends: object) -> bool:
    """Ask for a result; return whether it had to be made."""
    before = run.made
    found = run.cached(stage, depends, lambda: ROW)
    assert (found["number"], found["text"]) == (3, "three")
    assert found["rows"].dtype == ROW["rows"].dtype
    np.testing.assert_array_equal(found["rows"], ROW["rows"])
    return run.made > before


def test_a_result_is_made_once_and_again_when_anything_changes(tmp_path: Path) -> None:
    run = Run(tmp_path, tmp_path)
    asked = [
        (stage, depends)
        for stage in ("matches", "keypoints")
        for depends in ({"k": 1}, {"k": 2}, {"k": "1"}, {"k": None}, np.eye(3), 2 * np.eye(3))
    ]
    assert all(is_made(run, *each) for each in asked)
    assert not any(is_made(Run(tmp_path, tmp_path), *each) for each in asked)
    assert all(is_made(Run(tmp_path), *each) for each in asked)


def test_a_damaged_file_is_made_anew_and_repaired(tmp_path: Path) -> None:
    run = Run(tmp_path, tmp_path)
    is_made(run, "matches", 1)
    (path,) = tmp_path.rglob("*.npz")
    path.write_bytes(path.read_bytes()[:-9])
    assert is_made(run, "matches", 1)
    assert not is_made(run, "matches", 1)


def test_a_raised_version_makes_a_stage_again_and_what_is_made_from_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Run(tmp_path, tmp_path)
    assert all(is_made(run, stage, 1) for stage in STAGES)
    monkeypatch.setitem(STAGES, "matches", (99, STAGES["matches"][1]))
    again = [stage for stage in STAGES if is_made(run, stage, 1)]
    assert again == ["matches", "corner_errors", "pose"]
    monkeypatch.setattr(cv2, "__version__", "0.0.0")
    assert all(is_made(run, stage, 1) for stage in STAGES)


def raises(error: BaseException) -> Callable[[], None]:
    def work() -> None:
        raise error

    return work


@pytest.mark.parametrize("error", [ImageError("reason"), DeepDetectError("reason")])
def test_what_cannot_be_done_is_skipped_with_its_reason(tmp_path: Path, error: Exception) -> None:
    run = Run(tmp_path)
    assert run.attempt("matches of Mine", raises(error)) is None
    assert run.skipped == run.failures == ["matches of Mine: reason"]
    assert run.attempt("sum", lambda one, other: one + other, 2, 3) == 5


@pytest.mark.parametrize(
    "error", [ValueError("reason"), MemoryError(), KeyboardInterrupt(), CacheError("no room")]
)
def test_a_bug_of_ours_is_no_skipped_line(tmp_path: Path, error: BaseException) -> None:
    run = Run(tmp_path)
    with pytest.raises(type(error)):
        run.attempt("matches", raises(error))
    assert run.skipped == []
