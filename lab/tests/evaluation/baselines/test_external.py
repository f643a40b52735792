"""Detectors from outside: functions, and tiny networks that find the bright pixels."""

from __future__ import annotations

import itertools
import os
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from scipy.ndimage import map_coordinates

from deepdetect import OptionError, WeightsError
from deepdetect.features.sift import root_sift_descriptors
from deepdetect.io.image import luma
from deepdetect_lab.evaluation.baselines.external import (
    _maxima,
    find_feature,
    onnx_feature,
    plugin_feature,
)
from deepdetect_lab.evaluation.baselines.method import BaselineError
from deepdetect_lab.evaluation.run import MatchSettings, Run

NUMBERS = itertools.count()
CORNERS = """
import numpy as np
import onnx
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


@pytest.mark.parametrize("given", ["np.eye(4, 8, dtype=np.float32)", "np.eye(4, 8).tolist()"])
def test_own_descriptors_take_part_in_matching(
    write: Write, photo_path: Path, crop: np.ndarray, given: str
) -> None:
    """Arrays and lists are equal, also when only the best keypoints count."""
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
        "return {'keypoints': [[0, 0]]}",
        "return {'keypoints': [[0, 0]], 'scores': [1, 2]}",
        "return {'keypoints': [[0, 0]], 'scores': [1], 'descriptors': [[1], [2]]}",
    ],
)
def test_a_wrong_answer_is_an_error_in_one_line(write: Write, crop: np.ndarray, body: str) -> None:
    method = plugin_feature(write(f"def find(rgb):\n    {body}") + ":find")
    with pytest.raises(BaselineError):
        method.detect(crop)


@pytest.mark.parametrize("error", ["ValueError('a\\nb')", "ZeroDivisionError()"])
def test_whatever_a_function_raises_is_an_error_of_the_baseline(
    write: Write, crop: np.ndarray, error: str
) -> None:
    name = write(f"def find(rgb):\n    raise {error}")
    with pytest.raises(BaselineError, match=error.partition("(")[0]) as caught:
        plugin_feature(f"{name}:find").detect(crop)
    assert name in str(caught.value)


def test_no_keypoints_are_an_answer(write: Write, crop: np.ndarray) -> None:
    name = write("def find(rgb):\n    return {'keypoints': [], 'scores': []}")
    method = plugin_feature(f"{name}:find")
    found = method.detect(crop)
    assert len(found) == 0
    assert len(method.describe(crop, found)) == 0


@pytest.mark.parametrize("target", ["no_such_module_of_ours:find", "json:decoder"])
def test_a_wrong_name_is_an_error(target: str) -> None:
    before = list(sys.path)
    with pytest.raises(OptionError, match=target):
        plugin_feature(target)
    assert sys.path == before


def test_the_version_follows_the_modules_file(write: Write) -> None:
    name = write(CORNERS % "")
    first = plugin_feature(f"{name}:find").version
    assert plugin_feature(f"{name}:find").version == first
    os.utime(f"{name}.py", ns=(10**18, 10**18))
    assert plugin_feature(f"{name}:find").version != first


Make = Callable[..., Path]


@pytest.fixture
def make(tmp_path: Path) -> Make:
    """Write a network whose keypoints are the pixels with a red over 0.5."""
    helper, types = onnx.helper, onnx.TensorProto

    def write(
        size: tuple[object, object] = ("height", "width"),
        *,
        leading: bool = False,
        descriptors: bool = False,
        integers: bool = False,
        rename: str = "keypoints",
        name: str = "bright.onnx",
    ) -> Path:
        after = "_flat" if leading else ""
        nodes = [
            helper.make_node("Gather", ["image", "first"], ["red"], axis=1),
            helper.make_node("Greater", ["red", "half"], ["bright"]),
            helper.make_node("NonZero", ["bright"], ["where"]),
            helper.make_node("Transpose", ["where"], ["at"]),
            helper.make_node("Gather", ["at", "order"], ["whole"], axis=1),
            helper.make_node(
                "Cast", ["whole"], [rename + after], to=types.INT64 if integers else types.FLOAT
            ),
            helper.make_node("GatherND", ["red", "at"], ["scores" + after]),
        ]
        outputs = [rename, "scores"]
        if descriptors:
            nodes.append(helper.make_node("Cast", ["at"], ["descriptors" + after], to=types.FLOAT))
            outputs.append("descriptors")
        if leading:
            nodes += [
                helper.make_node("Unsqueeze", [f"{output}_flat", "first"], [output])
                for output in outputs
            ]
        kinds = [
            types.INT64 if integers and output == rename else types.FLOAT for output in outputs
        ]
        graph = helper.make_graph(
            nodes,
            "bright",
            [helper.make_tensor_value_info("image", types.FLOAT, [1, 3, *size])],
            [
                helper.make_tensor_value_info(output, kind, None)
                for output, kind in zip(outputs, kinds, strict=True)
            ],
            [
                helper.make_tensor("first", types.INT64, [1], [0]),
                helper.make_tensor("half", types.FLOAT, [], [0.5]),
                helper.make_tensor("order", types.INT64, [2], [3, 2]),
            ],
        )
        opset = [helper.make_opsetid("", 13)]
        path = tmp_path / name
        path.write_bytes(
            helper.make_model(graph, opset_imports=opset, ir_version=8).SerializeToString()
        )
        return path

    return write


def picture(width: int, height: int, *blocks: tuple[int, int, int, int], red: int = 255):
    """Black, with red blocks: column, row, width and height."""
    rgb = np.zeros((height, width, 3), np.uint8)
    for column, row, wide, high in blocks:
        rgb[row : row + high, column : column + wide, 0] = red
    return rgb


@pytest.mark.parametrize("leading", [False, True])
@pytest.mark.parametrize("integers", [False, True])
def test_a_network_of_any_size_sees_the_pixels_as_they_are(
    make: Make, leading: bool, integers: bool
) -> None:
    method = onnx_feature(make(leading=leading, integers=integers))
    rgb = picture(40, 30, (7, 3, 1, 1), (39, 29, 1, 1), (0, 0, 1, 1), red=204)
    rgb[10, 10] = (0, 255, 0)  # green and blue are other channels
    rgb[11, 10] = (0, 0, 255)
    found = method.detect(rgb)
    assert found.xy.tolist() == [[0, 0], [7, 3], [39, 29]]
    np.testing.assert_allclose(found.scores, 0.8, rtol=1e-6)
    assert found.image_size == (40, 30)
    assert found.xy.dtype == np.float32


@pytest.mark.parametrize(
    ("width", "height", "block", "centre"),
    [
        (96, 64, (20, 10, 2, 2), (20.5, 10.5)),  # two of the image's pixels are one
        (96, 64, (94, 62, 2, 2), (94.5, 62.5)),
        (144, 64, (30, 10, 3, 2), (31, 10.5)),  # each side by its own factor
    ],
)
def test_keypoints_of_a_shrunk_image_are_the_centres_of_what_became_one_pixel(
    make: Make, width: int, height: int, block: tuple[int, ...], centre: tuple[float, float]
) -> None:
    found = onnx_feature(make((32, 48))).detect(picture(width, height, block))
    np.testing.assert_allclose(found.xy, [centre], atol=1e-5)
    assert found.image_size == (width, height)


@pytest.mark.parametrize("leading", [False, True])
def test_descriptors_of_the_network_are_kept_and_count_as_learned(
    make: Make, leading: bool
) -> None:
    method = onnx_feature(make(descriptors=True, leading=leading))
    assert method.learned
    rgb = picture(40, 30, (7, 3, 1, 1), (20, 9, 1, 1))
    found = method.detect(rgb)
    # This network describes a pixel by its place: batch, channel, row and column.
    assert method.describe(rgb, found).tolist() == [[0, 0, 3, 7], [0, 0, 9, 20]]
    best = found[np.array([1])]
    assert method.describe(rgb, best).tolist() == [[0, 0, 9, 20]]


@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
def test_maxima_of_a_map_of_logits_are_described_between_the_cells(
    tmp_path: Path, backend: str
) -> None:
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    # Logits from -10 to 10 of the grey image, and per 4x4 pixels their mean and its square.
    nodes = [
        helper.make_node("Mul", ["image", "twenty"], ["scaled"]),
        helper.make_node("Sub", ["scaled", "ten"], ["scores"]),
        helper.make_node("AveragePool", ["image"], ["mean"], kernel_shape=[4, 4], strides=[4, 4]),
        helper.make_node("Mul", ["mean", "mean"], ["square"]),
        helper.make_node("Concat", ["mean", "square"], ["descriptors"], axis=1),
    ]
    graph = helper.make_graph(
        nodes,
        "maps",
        [helper.make_tensor_value_info("image", kind, [1, 1, "height", "width"])],
        [helper.make_tensor_value_info(name, kind, None) for name in ("descriptors", "scores")],
        [helper.make_tensor(n, kind, [], [v]) for n, v in (("twenty", 20.0), ("ten", 10.0))],
    )
    opset = [helper.make_opsetid("", 13)]
    path = tmp_path / "maps.onnx"
    path.write_bytes(
        helper.make_model(graph, opset_imports=opset, ir_version=8).SerializeToString()
    )
    rgb = np.random.default_rng(0).integers(0, 40, (64, 96, 3), np.uint8)
    bright = {(4, 4): 200, (91, 59): 180, (50, 30): 250, (52, 32): 240, (3, 20): 255, (20, 60): 255}
    for (x, y), value in bright.items():
        rgb[y, x] = value
    method = onnx_feature(path, backend, threads=1)
    assert method.learned
    found = method.detect(rgb)
    # (52, 32) is in the window of a higher one, the last two are nearer than 4 px to the border.
    assert found.xy.tolist() == [[4, 4], [50, 30], [91, 59]]
    np.testing.assert_allclose(found.scores, 20 * np.array([200, 250, 180]) / 255 - 10, atol=1e-4)
    mean = rgb.mean(axis=2).reshape(16, 4, 24, 4).mean(axis=(1, 3)) / 255
    places = (found.xy.T[::-1] + 0.5) / 4 - 0.5
    expected = np.stack([map_coordinates(each, places, order=1) for each in (mean, mean**2)])
    expected /= np.linalg.norm(expected, axis=0)
    np.testing.assert_allclose(method.describe(rgb, found), expected.T, atol=1e-5)
    # Of other sizes the nearest multiples of 32 are looked at.
    larger = np.zeros((72, 100, 3), np.uint8)
    larger[36:45, 50:60] = 255
    np.testing.assert_allclose(method.detect(larger).xy.mean(axis=0), [54.5, 40], atol=1)


def test_points_without_descriptors_get_upright_rootsift_of_size_4(
    make: Make, photo: np.ndarray
) -> None:
    method = onnx_feature(make())
    assert not method.learned
    crop = np.ascontiguousarray(photo[:60, :80])
    found = method.detect(crop)[:50]
    expected = root_sift_descriptors(luma(crop), found.xy, 4.0, 0.0)
    np.testing.assert_array_equal(method.describe(crop, found), expected)


def test_the_name_is_the_files_and_the_version_its_content(make: Make) -> None:
    path = make(name="Bright one.onnx")
    method = onnx_feature(path)
    assert method.name == method.title == "Bright one"
    moved = path.rename(path.with_name("moved.onnx"))
    assert onnx_feature(moved).version == method.version
    assert onnx_feature(make(descriptors=True)).version != method.version
    assert find_feature(str(moved)).name == "moved"


def test_what_is_no_network_is_said(make: Make, tmp_path: Path) -> None:
    text = tmp_path / "text.onnx"
    text.write_text("no network")
    half = tmp_path / "half.onnx"
    half.write_bytes(make().read_bytes()[:200])
    other = make(rename="points", name="other.onnx")
    for path in (tmp_path / "none.onnx", tmp_path, text, half, other):
        with pytest.raises(WeightsError, match=path.name):
            onnx_feature(path)


def test_descriptors_are_read_up_to_the_border_of_a_coarse_map() -> None:
    logits = np.full((64, 96), -9.0, np.float32)
    logits[59, 91] = 9.0  # beyond the middle of the last cell of 32 pixels
    values = np.arange(1.0, 13).reshape(2, 2, 3).astype(np.float32)
    found = _maxima(logits, values)
    assert found["keypoints"].tolist() == [[91, 59]]
    corner = values[:, -1, -1]
    np.testing.assert_allclose(found["descriptors"], [corner / np.linalg.norm(corner)], rtol=1e-6)
