from __future__ import annotations

import itertools
import os
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from deepdetect import OptionError
from deepdetect.evaluation.baselines.method import BaselineError
from deepdetect.evaluation.baselines.plugin import find_feature, plugin_feature
from deepdetect.evaluation.run import MatchSettings, Run

NUMBERS = itertools.count()
CORNERS = """
import numpy as np
def find(rgb):
    assert rgb.dtype == np.uint8 and rgb.ndim == 3
    height, width = rgb.shape[:2]
    points = [[0, 0], [width - 1, 0], [width - 1, height - 1], [20, 25]]
    return {"keypoints": points, "scores": [0.1, 0.4, 0.3, 0.2]%s}
"""
Write = Callable[[str], str]


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Write:
    """Write a module into the current folder, under a name that no other test has."""
    monkeypatch.chdir(tmp_path)

    def module(text: str) -> str:
        name = f"own_detector_{os.getpid()}_{next(NUMBERS)}"
        Path(f"{name}.py").write_text(text)
        return name

    return module


@pytest.fixture
def crop(photo: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(photo[:60, :80])


def test_a_function_in_the_current_folder_is_found(write: Write, crop: np.ndarray) -> None:
    before = list(sys.path)
    target = write(CORNERS % "") + ":find"
    method = plugin_feature(target)
    assert sys.path == before
    assert method.name == method.title == target
    found = method.detect(crop)
    assert found.xy.tolist() == [[0, 0], [79, 0], [79, 59], [20, 25]]
    assert found.image_size == (80, 60)
    assert found.best(2).xy.tolist() == [[79, 0], [79, 59]]
    assert find_feature(target).detect(crop).xy.tolist() == found.xy.tolist()


@pytest.mark.parametrize(
    "given", ["np.eye(4, 8, dtype=np.float32)", "np.eye(4, 8)", "np.eye(4, 8).tolist()"]
)
def test_own_descriptors_take_part_in_matching(
    write: Write, photo_path: Path, crop: np.ndarray, given: str
) -> None:
    """Float32, float64 and lists are equal, also when only the best keypoints count."""
    target = write(CORNERS % f", 'descriptors': {given}") + ":find"
    method = plugin_feature(target)
    np.testing.assert_array_equal(method.describe(crop, method.detect(crop)), np.eye(4, 8))
    for matcher, budget in (("exact", None), ("exact", 3), ("flann", None)):
        settings = MatchSettings(matcher, 0.9, budget=budget)
        found = Run(photo_path.parent).matches(method, (photo_path, photo_path), settings)
        assert len(found.points0) == (budget or 4)
        np.testing.assert_array_equal(found.points0, found.points1)


@pytest.mark.parametrize(
    "body",
    [
        "return None",
        "return [[0, 0]], [1]",
        "return {'keypoints': [[0, 0]]}",
        "return {'keypoints': [[0, 0, 0]], 'scores': [1]}",
        "return {'keypoints': [[0, 0]], 'scores': [1, 2]}",
        "return {'keypoints': [[0, float('nan')]], 'scores': [1]}",
        "return {'keypoints': [[0, 0]], 'scores': [1], 'descriptors': [[1], [2]]}",
    ],
)
def test_a_wrong_answer_is_an_error_in_one_line(
    write: Write, crop: np.ndarray, body: str, one_line
) -> None:
    method = plugin_feature(write(f"def find(rgb):\n    {body}") + ":find")
    with pytest.raises(BaselineError) as caught:
        method.detect(crop)
    one_line(caught.value)


@pytest.mark.parametrize("error", ["ValueError('a\\nb')", "ZeroDivisionError()", "KeyError('x')"])
def test_whatever_a_function_raises_is_an_error_of_the_baseline(
    write: Write, crop: np.ndarray, error: str, one_line
) -> None:
    name = write(f"def find(rgb):\n    raise {error}")
    with pytest.raises(BaselineError, match=error.partition("(")[0]) as caught:
        plugin_feature(f"{name}:find").detect(crop)
    assert name in one_line(caught.value)


def test_no_keypoints_are_an_answer(write: Write, crop: np.ndarray) -> None:
    name = write("def find(rgb):\n    return {'keypoints': [], 'scores': []}")
    method = plugin_feature(f"{name}:find")
    found = method.detect(crop)
    assert len(found) == 0
    assert len(method.describe(crop, found)) == 0


@pytest.mark.parametrize(
    "target",
    [
        "no_such_module_of_ours:find",
        "json:no_such_function",
        "json:",
        ":dumps",
        ":",
        "json:decoder",
        ".json:dumps",
    ],
)
def test_a_wrong_name_is_an_error_in_one_line(target: str, one_line) -> None:
    before = list(sys.path)
    with pytest.raises(OptionError) as caught:
        plugin_feature(target)
    assert target in one_line(caught.value)
    assert sys.path == before


def test_the_version_follows_the_modules_file(write: Write) -> None:
    name = write(CORNERS % "")
    first = plugin_feature(f"{name}:find").version
    assert plugin_feature(f"{name}:find").version == first
    os.utime(f"{name}.py", ns=(10**18, 10**18))
    assert plugin_feature(f"{name}:find").version != first


@pytest.mark.parametrize(
    ("word", "nearest"),
    [("siift", "sift"), ("SIFT", "sift"), ("fast_low", "fast-low"), ("shitomasi", "shi-tomasi")],
)
def test_an_unknown_word_brings_the_nearest_and_the_other_ways(
    word: str, nearest: str, one_line
) -> None:
    with pytest.raises(OptionError) as caught:
        find_feature(word)
    message = one_line(caught.value)
    assert f"did you mean {nearest!r}" in message
    assert "ONNX" in message
    assert "package.module:function" in message
