from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.distance import cdist

from deepdetect import DeepDetectError, ImageError
from deepdetect.evaluation import context as context_module
from deepdetect.evaluation.baselines.method import BaselineError, LocalFeature
from deepdetect.evaluation.baselines.opencv import CLASSICAL
from deepdetect.evaluation.cache import CacheError, StageCache, file_digest
from deepdetect.evaluation.context import (
    BenchmarkContext,
    ImageKeypoints,
    MatchSettings,
    PairMatches,
)
from deepdetect.evaluation.profiling import Profile
from deepdetect.features.keypoints import Keypoints
from deepdetect.io.image import load_image, luma

Pair = tuple[Path, Path]
FAST = CLASSICAL["fast"]


def find_keypoints(cache: StageCache, method: LocalFeature, image: Path) -> ImageKeypoints:
    """As the next run of the program does."""
    return BenchmarkContext(image.parent, cache).keypoints(method, image)


def find_matches(
    cache: StageCache, method: LocalFeature, images: Pair, settings: MatchSettings
) -> PairMatches:
    """As the next run of the program does."""
    return BenchmarkContext(images[0].parent, cache).matches(method, images, settings)


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


@pytest.mark.parametrize("name", ["sift", "orb", "fast", "harris", "shi-tomasi"])
def test_keypoints_from_the_cache_equal_fresh_ones(tmp_path: Path, pair: Pair, name: str) -> None:
    method, asked = counted(CLASSICAL[name])
    cache = StageCache(tmp_path)
    fresh = method.detect(load_image(pair[0]))
    made, found = (find_keypoints(cache, method, pair[0]) for _ in range(2))
    assert len(asked) == 2  # ours, and the first of the cache
    assert_same(made.features, fresh)
    assert_same(found.features, fresh)
    # The cost is that of the making, also when it is read.
    assert made.profile == found.profile
    assert made.profile.seconds > 0


@pytest.mark.parametrize(
    "xy",
    [
        [(0, 0), (119, 99)],
        [(0.5, 0.25), (119.49, 98.999)],
        [(-0.4, -7), (3, 3)],
        [(32767, 32766), (-32768, 0)],
        [(32768, 0), (40000, 65536)],
        [(1e-30, 1e9), (3, 3)],
        [],
    ],
    ids=["whole", "parts", "negative", "largest", "larger", "extreme", "none"],
)
def test_positions_are_kept_to_the_last_bit(tmp_path: Path, pair: Pair, xy) -> None:
    method = points(*xy)
    for _ in range(2):
        found = find_keypoints(StageCache(tmp_path), method, pair[0]).features
        assert found.xy.dtype == np.float32
        np.testing.assert_array_equal(found.xy, np.array(xy, np.float32).reshape(-1, 2))


def test_whole_positions_take_half_the_room(tmp_path: Path, pair: Pair) -> None:
    generator = np.random.default_rng(0)
    xy = generator.integers(0, 100, (5000, 2))
    sizes = []
    for name, shift in (("whole", 0), ("parts", 0.37)):
        cache = StageCache(tmp_path / name)
        find_keypoints(cache, points(*(xy + shift).tolist()), pair[0])
        (file,) = (tmp_path / name).rglob("*.npz")
        sizes.append(file.stat().st_size)
    assert sizes[0] < sizes[1]


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
        found = find_keypoints(StageCache(tmp_path), method, pair[0]).features
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
    cache = StageCache(tmp_path)
    fresh = find_matches(StageCache(None), method, pair, settings)
    made = find_matches(cache, method, pair, settings)
    asked.clear()
    found = find_matches(cache, method, pair, settings)
    assert asked == []
    assert len(fresh) > 20
    for part in ("points0", "points1", "keypoints0", "keypoints1"):
        np.testing.assert_array_equal(getattr(made, part), getattr(fresh, part))
        np.testing.assert_array_equal(getattr(found, part), getattr(fresh, part))
    assert (found.match, found.describe) == (made.match, made.describe)


def test_matches_of_binary_descriptors_equal_a_count_of_all_bits(pair: Pair) -> None:
    grays = [luma(load_image(path)) for path in pair]
    keypoints, described = zip(
        *(cv2.ORB_create().detectAndCompute(gray, None) for gray in grays), strict=True
    )
    bits = [np.unpackbits(rows, axis=1).astype(float) for rows in described]
    every = cdist(*bits, "cityblock")
    ordered = np.sort(every, axis=1)
    kept = ordered[:, 0] < 0.8 * ordered[:, 1]
    found = find_matches(StageCache(None), CLASSICAL["orb"], pair, MatchSettings(ratio=0.8))
    positions = [np.array([p.pt for p in part], np.float32) for part in keypoints]
    np.testing.assert_array_equal(found.points0, positions[0][kept])
    np.testing.assert_array_equal(found.points1, positions[1][every.argmin(1)[kept]])
    assert len(found.keypoints1) == len(positions[1])
    # The crops are (6, 4) apart.
    gaps = np.linalg.norm(found.points0 - (6, 4) - found.points1, axis=1)
    assert (gaps < 2).mean() > 0.8


def test_matches_by_euclid_equal_a_search_of_all_distances(pair: Pair) -> None:
    images = [load_image(path) for path in pair]
    method = CLASSICAL["sift"]
    features = [method.detect(rgb).best(60) for rgb in images]
    rows = [method.describe(*both) for both in zip(images, features, strict=True)]
    every = cdist(*[part.astype(float) for part in rows])
    ordered = np.sort(every, axis=1)
    kept = ordered[:, 0] < 0.85 * ordered[:, 1]
    kept &= every.argmin(0)[every.argmin(1)] == np.arange(len(every))
    settings = MatchSettings("exact", 0.85, mutual=True, budget=60)
    found = find_matches(StageCache(None), method, pair, settings)
    assert 10 < len(found) < 60
    np.testing.assert_array_equal(found.points0, features[0].xy[kept])
    np.testing.assert_array_equal(found.points1, features[1].xy[every.argmin(1)[kept]])
    assert len(found.keypoints0) == len(found.keypoints1) == 60


Change = Callable[[LocalFeature], LocalFeature]


@pytest.mark.parametrize(
    ("change", "asked_again"),
    [
        (lambda m: dataclasses.replace(m, detection="", version="2"), ["detect", "describe"]),
        (lambda m: dataclasses.replace(m, detection="", name="other"), ["detect", "describe"]),
        (lambda m: dataclasses.replace(m, version="2"), ["describe"]),
        (lambda m: dataclasses.replace(m, name="other"), ["describe"]),
        (lambda m: dataclasses.replace(m, title="Other"), []),
    ],
    ids=["version", "name", "version of the descriptor", "name of the descriptor", "title"],
)
def test_another_version_is_not_served_and_shared_keypoints_are(
    tmp_path: Path, pair: Pair, change: Change, asked_again: list[str]
) -> None:
    method, asked = counted(CLASSICAL["fast"])
    cache = StageCache(tmp_path)
    find_matches(cache, method, pair, MatchSettings())
    asked.clear()
    find_matches(cache, change(method), pair, MatchSettings())
    assert sorted(set(asked)) == sorted(asked_again)
    asked.clear()
    find_matches(cache, method, pair, MatchSettings())
    assert asked == []


@pytest.mark.parametrize(
    "settings",
    [
        MatchSettings("exact"),
        MatchSettings(ratio=0.9),
        MatchSettings(mutual=True),
        MatchSettings(budget=50),
        MatchSettings(seed=1),
    ],
    ids=str,
)
def test_other_settings_are_matched_anew_from_the_same_keypoints(
    tmp_path: Path, pair: Pair, settings: MatchSettings
) -> None:
    method, asked = counted(CLASSICAL["fast"])
    cache = StageCache(tmp_path)
    find_matches(cache, method, pair, MatchSettings())
    asked.clear()
    found = find_matches(cache, method, pair, settings)
    assert asked == ["describe", "describe"]
    fresh = find_matches(StageCache(None), method, pair, settings)
    np.testing.assert_array_equal(found.points0, fresh.points0)


def test_the_two_directions_of_a_pair_are_not_mixed_up(tmp_path: Path, pair: Pair) -> None:
    cache = StageCache(tmp_path)
    there = find_matches(cache, CLASSICAL["fast"], pair, MatchSettings())
    back = find_matches(cache, CLASSICAL["fast"], pair[::-1], MatchSettings())
    np.testing.assert_array_equal(there.keypoints0, back.keypoints1)
    assert not np.array_equal(there.points0[:20], back.points0[:20])


def test_another_image_under_the_same_name_is_detected_anew(
    tmp_path: Path, photo: np.ndarray
) -> None:
    """As in the next run of the program, which reads all files again."""
    path = tmp_path / "image.png"
    cache = StageCache(tmp_path / "cache")
    found = []
    for left in (0, 60):
        Image.fromarray(photo[50:150, left : left + 100]).save(path)
        file_digest.cache_clear() if hasattr(file_digest, "cache_clear") else None
        found.append(find_keypoints(cache, CLASSICAL["fast"], path).features)
        assert_same(found[-1], CLASSICAL["fast"].detect(photo[50:150, left : left + 100]))
    assert cache.made == 2


def test_the_same_image_under_another_name_is_found(tmp_path: Path, pair: Pair) -> None:
    copy = tmp_path / "copy.png"
    copy.write_bytes(pair[0].read_bytes())
    cache = StageCache(tmp_path / "cache")
    find_keypoints(cache, CLASSICAL["fast"], pair[0])
    find_keypoints(cache, CLASSICAL["fast"], copy)
    assert cache.made == 1


def test_a_descriptor_for_each_keypoint_is_asked_for(pair: Pair, one_line) -> None:
    method = dataclasses.replace(
        CLASSICAL["fast"], describe=lambda rgb, features: np.zeros((3, 128), np.float32)
    )
    with pytest.raises(BaselineError, match="one for each") as caught:
        find_matches(StageCache(None), method, pair, MatchSettings())
    one_line(caught.value)


@pytest.mark.parametrize("matcher", ["flann", "exact"])
@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_keypoints_are_no_error(pair: Pair, matcher: str, count: int) -> None:
    method = points(*[(20, 30), (60, 40)][:count])
    found = find_matches(StageCache(None), method, pair, MatchSettings(matcher))
    assert found.points0.shape == found.points1.shape == (len(found), 2)
    assert len(found.keypoints0) == count
    assert count == 2 or len(found) == 0


def test_no_stage_is_timed_while_files_are_read(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Detecting and describing stand beside each other, so they must mean the same."""
    timing = []
    read_while_timing = []

    @contextmanager
    def watched() -> Iterator[Profile]:
        timing.append(True)
        yield Profile()
        timing.pop()

    def load(path: Path) -> np.ndarray:
        read_while_timing.extend(timing)
        return load_image(path)

    monkeypatch.setattr(context_module, "profiled", watched)
    monkeypatch.setattr(context_module, "load_image", load)
    find_keypoints(StageCache(None), CLASSICAL["fast"], pair[0])
    assert read_while_timing == []
    find_matches(StageCache(None), CLASSICAL["fast"], pair, MatchSettings())
    assert read_while_timing == []


def raises(error: Exception) -> Callable[[], None]:
    def work() -> None:
        raise error

    return work


@pytest.mark.parametrize(
    "error", [ImageError("reason"), DeepDetectError("reason"), BaselineError("reason")]
)
def test_what_cannot_be_done_is_skipped_with_its_reason(tmp_path: Path, error: Exception) -> None:
    context = BenchmarkContext(tmp_path)
    assert context.try_run("matches of Mine", raises(error)) is None
    assert context.skipped == context.failures == ["matches of Mine: reason"]


@pytest.mark.parametrize(
    "error",
    [
        *(ValueError("reason"), TypeError("reason"), KeyError("reason"), AssertionError("reason")),
        *(MemoryError(), np.linalg.LinAlgError("Singular matrix"), KeyboardInterrupt()),
        CacheError("no room"),
    ],
    ids=repr,
)
def test_a_bug_of_ours_is_no_skipped_line(tmp_path: Path, error: Exception) -> None:
    context = BenchmarkContext(tmp_path)
    with pytest.raises(type(error)):
        context.try_run("matches", raises(error))
    assert context.skipped == []


def test_what_works_is_returned(tmp_path: Path) -> None:
    context = BenchmarkContext(tmp_path)
    assert context.try_run("sum", lambda: 2 + 3) == 5
    assert context.skipped == []


def test_a_data_set_is_below_the_folder_or_is_the_folder(tmp_path: Path) -> None:
    context = BenchmarkContext(tmp_path)
    assert context.folder("oxford") == tmp_path
    (tmp_path / "oxford").mkdir()
    assert context.folder("oxford") == tmp_path / "oxford"
    assert context.folder("hpatches") == tmp_path


def asked(context: BenchmarkContext, *arguments: object, stage: str = "coverage") -> bool:
    """Ask for a metric; return whether it had to be made."""
    made = []
    context.metric(stage, *arguments, lambda: made.append(1) or {"value": np.array(0.5)})
    return bool(made)


def test_a_metric_is_made_again_when_anything_it_depends_on_changes(
    tmp_path: Path, pair: Pair
) -> None:
    context = BenchmarkContext(tmp_path, StageCache(tmp_path / "cache"))
    newer = dataclasses.replace(FAST, version="2")
    renamed = dataclasses.replace(FAST, name="other")
    for turn in range(2):
        calls = [
            asked(context, FAST, pair[:1], {}),
            asked(context, FAST, pair[:1], {"budget": 5}),
            asked(context, FAST, pair, {}),
            asked(context, FAST, pair[::-1], {}),
            asked(context, newer, pair[:1], {}),
            asked(context, renamed, pair[:1], {}),
            asked(context, FAST, pair[:1], {}, stage="foreground"),
        ]
        assert calls == [turn == 0] * len(calls)


def test_a_pair_is_described_once_for_all_settings(tmp_path: Path, pair: Pair) -> None:
    method, calls = counted(FAST)
    context = BenchmarkContext(tmp_path)
    found = [context.matches(method, pair, MatchSettings("exact", r)) for r in (0.8, 0.9, 1.0)]
    assert sorted(calls) == ["describe", "describe", "detect", "detect"]
    assert 0 < len(found[0]) < len(found[1]) < len(found[2])
    context.matches(method, pair[::-1], MatchSettings("exact"))
    assert sorted(calls) == ["describe"] * 4 + ["detect"] * 2
