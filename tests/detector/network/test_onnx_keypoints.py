"""Files that give keypoints give those of `DeepDetect.detect`, in other runtimes, too."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

onnx = pytest.importorskip("onnx", reason="needs onnx, which is for exporting only")

import cv2  # noqa: E402
import onnxruntime  # noqa: E402

from deepdetect import DeepDetect  # noqa: E402
from deepdetect.detector.network.onnx_export import OnnxOptions, write_onnx  # noqa: E402
from deepdetect.detector.network.onnx_keypoints import MAX_KEYPOINTS, add_keypoints  # noqa: E402
from deepdetect.detector.pretrained import pretrained_weights  # noqa: E402
from deepdetect.features.keypoints import Keypoints  # noqa: E402
from deepdetect.features.selection import (  # noqa: E402
    SelectionOptions,
    select_keypoints,
    sigmoid,
)

COUNT = 90
SIZES = [(64, 96), (123, 157), (17, 23), (80, 41)]
"""Heights and widths: multiples of 8, of 8 in one direction, and of none; one has fewer pixels."""

OUTPUTS = ["keypoints", "keypoint_logits"]


def planes_of(*images: np.ndarray) -> np.ndarray:
    """Return (B, 3, H, W) float32, as the file takes images of one size."""
    return np.ascontiguousarray(np.stack(images).transpose(0, 3, 1, 2) * np.float32(1 / 255))


def session_of(model: Path | bytes) -> onnxruntime.InferenceSession:
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads, settings.log_severity_level = 1, 4
    given = model if isinstance(model, bytes) else str(model)
    return onnxruntime.InferenceSession(given, settings, providers=["CPUExecutionProvider"])


def check_keypoints(
    xy: np.ndarray, logits: np.ndarray, expected: Keypoints, count: int, tolerance: float = 1e-4
) -> None:
    """Check the keypoints of one image: the positions in pixels, their order, and the rest."""
    assert (xy.shape, logits.shape) == ((count, 2), (count,))
    assert xy.dtype == logits.dtype == np.float32
    assert np.isfinite(logits).sum() == len(expected)
    order = np.argsort(-expected.logits, kind="stable")
    found = slice(len(expected))
    np.testing.assert_allclose(logits[found], expected.logits[order], atol=1e-3)
    np.testing.assert_allclose(xy[found], expected.xy[order], atol=tolerance)
    assert np.isneginf(logits[len(expected) :]).all()
    assert (xy[len(expected) :] == -1).all()


def best(rgb: np.ndarray, count: int = COUNT, weights: Any = "default") -> Keypoints:
    detector = DeepDetect(weights, backend="onnxruntime", threads=1)
    return detector.detect(rgb, max_keypoints=count, nms_radius=1, subpixel=True)


def best_of(count: int) -> SelectionOptions:
    """Return how a file with keypoints selects them."""
    return SelectionOptions(max_keypoints=count, nms_radius=1, subpixel=True)


@pytest.fixture(scope="module", params=[MAX_KEYPOINTS, COUNT], ids=["shipped", "made"])
def count(request: pytest.FixtureRequest) -> int:
    """How many keypoints the file gives that is tested."""
    return int(request.param)


@pytest.fixture(scope="module")
def path(count: int, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file for any size that gives keypoints: the shipped one, or another."""
    made = pretrained_weights()
    if count != MAX_KEYPOINTS:
        made = tmp_path_factory.mktemp("keypoints") / "keypoints.onnx"
        write_onnx("default", made, OnnxOptions(max_keypoints=count))
    onnx.checker.check_model(onnx.load(made), full_check=True)
    return made


@pytest.fixture(scope="module")
def session(path: Path) -> onnxruntime.InferenceSession:
    return session_of(path)


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_they_are_what_detect_finds(
    height: int, width: int, session: Any, count: int, photo: np.ndarray
) -> None:
    rgb = photo[:height, :width]
    xy, values = session.run(OUTPUTS, {"image": planes_of(rgb)})
    expected = best(rgb, count)
    assert count == MAX_KEYPOINTS or (len(expected) < count) == (width < 64)
    check_keypoints(xy[0], values[0], expected, count)


def test_a_batch_gives_those_of_each_image(session: Any, count: int, photo: np.ndarray) -> None:
    # The second one has fewer.
    images = [photo[:123, :157], photo[100:223, 60:217].copy()]
    images[1][:, 15:] = 128
    xy, values = session.run(OUTPUTS, {"image": planes_of(*images)})
    for k, rgb in enumerate(images):
        check_keypoints(xy[k], values[k], best(rgb, count), count)
    assert np.isfinite(values).sum(1)[1] < count


@pytest.mark.parametrize(("size", "batch"), [((123, 157), 2), ((17, 23), 1)])
def test_one_size(size: tuple[int, int], batch: int, tmp_path: Path, photo: np.ndarray) -> None:
    height, width = size
    # More than there are pixels in the smallest.
    options = OnnxOptions(size, batch, max_keypoints=500)
    made = tmp_path / "one.onnx"
    assert write_onnx("default", made, options)["max_keypoints"] == "500"
    model = onnx.load(made)
    onnx.checker.check_model(model, full_check=True)
    assert "Shape" not in {node.op_type for node in model.graph.node}
    shapes = {
        value.name: [side.dim_value for side in value.type.tensor_type.shape.dim]
        for value in model.graph.output
    }
    assert shapes["keypoints"] == [batch, 500, 2]
    assert shapes["keypoint_logits"] == [batch, 500]
    images = [photo[9 * k : 9 * k + height, 5 * k : 5 * k + width] for k in range(batch)]
    logits, xy, values = session_of(made).run(["logits", *OUTPUTS], {"image": planes_of(*images)})
    for k in range(batch):
        selected = select_keypoints(sigmoid(logits[k, 0]), best_of(500), logits[k, 0])
        check_keypoints(xy[k], values[k], selected, 500)
        check_keypoints(xy[k], values[k], best(images[k], 500), 500)


def same_share(xy: np.ndarray, values: np.ndarray, expected: Keypoints) -> float:
    """Return the share of keypoints that another runtime finds within a hundredth of a pixel."""
    assert np.isfinite(values).sum() == len(expected)
    assert (np.diff(values[np.isfinite(values)]) <= 0).all()
    found = xy[np.isfinite(values)]
    gaps = np.linalg.norm(found[:, None] - expected.xy, axis=2)
    return float(np.mean(gaps.min(0) < 0.01))


def test_openvino(path: Path, count: int, photo: np.ndarray) -> None:
    openvino = pytest.importorskip("openvino", reason="needs OpenVINO")
    settings = {"INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": 1}
    model = openvino.Core().compile_model(str(path), "CPU", settings)
    for height, width in SIZES:
        images = [photo[:height, :width], photo[40 : 40 + height, 30 : 30 + width]]
        found = model([planes_of(*images)])
        for k, rgb in enumerate(images):
            expected = best(rgb, count)
            shares = same_share(found["keypoints"][k], found["keypoint_logits"][k], expected)
            assert shares > 0.99


@pytest.mark.skipif(cv2.__version__ < "5", reason="needs the new engine of OpenCV 5")
def test_opencv_5(path: Path, count: int, photo: np.ndarray) -> None:
    network = cv2.dnn.readNetFromONNX(str(path), cv2.dnn.ENGINE_NEW)
    for height, width in SIZES:
        images = [photo[:height, :width], photo[40 : 40 + height, 30 : 30 + width]]
        network.setInput(planes_of(*images))
        *_, xy, values = network.forward(["probability", "logits", *OUTPUTS])
        for k, rgb in enumerate(images):
            assert same_share(xy[k], values[k], best(rgb, count)) > 0.99


@pytest.fixture(scope="module")
def keypoints_of() -> Any:
    """What finds the keypoints of any (B, 1, H, W) logits, and what `select_keypoints` finds."""
    from onnx import TensorProto, helper

    def find(logits: np.ndarray, count: int) -> tuple[list[np.ndarray], list[Keypoints]]:
        sides = ("batch", 1, "height", "width")
        graph = helper.make_graph(
            [helper.make_node("Identity", ["image"], ["logits"])],
            "identity",
            [helper.make_tensor_value_info("image", TensorProto.FLOAT, sides)],
            [helper.make_tensor_value_info("logits", TensorProto.FLOAT, sides)],
        )
        opset = helper.make_opsetid("", 17)
        model = helper.make_model(graph, opset_imports=[opset], ir_version=8)
        add_keypoints(model, count)
        found = session_of(model.SerializeToString()).run(OUTPUTS, {"image": logits})
        return found, [
            select_keypoints(sigmoid(each), best_of(count), each) for each in logits[:, 0]
        ]

    return find


def sorted_rows(xy: np.ndarray) -> np.ndarray:
    return xy[np.lexsort(xy.T)]


@pytest.mark.parametrize(
    "size", [(1, 1), (1, 7), (2, 2), (5, 1), (24, 31), pytest.param((3, 5000), id="wide")]
)
def test_any_logits(size: tuple[int, int], keypoints_of: Any) -> None:
    """Also of images too small for `detect`, at the border, and with equal neighbours."""
    generator = np.random.default_rng(0)
    for step in (1e-6, 0.5, 2):  # of the logits: the last ones have plateaus
        logits = generator.normal(1, 2, (3, 1, *size))
        logits = (np.round(logits / step) * step).astype(np.float32)
        found, expected = keypoints_of(logits, 4000)
        for xy, values, keypoints in zip(*found, expected, strict=True):
            kept = np.isfinite(values)
            assert kept.sum() == len(keypoints)
            np.testing.assert_array_equal(values[kept], -np.sort(-keypoints.logits))
            np.testing.assert_allclose(
                sorted_rows(xy[kept]), sorted_rows(keypoints.xy), atol=2e-6 * max(size)
            )


def test_of_equal_ones_at_the_last_place_any_are_kept(keypoints_of: Any) -> None:
    logits = np.full((1, 1, 12, 12), -1, np.float32)
    logits[0, 0, ::3, ::3] = 2
    logits[0, 0, 6, 6] = 3
    (xy, values), (expected,) = keypoints_of(logits, 4)
    np.testing.assert_array_equal(values, [[3, 2, 2, 2]])
    assert len(expected) == 4
    assert xy[0, 0].tolist() == [6, 6]
    assert (logits[0, 0][xy[0].astype(int)[:, 1], xy[0].astype(int)[:, 0]] == values[0]).all()
    assert len(np.unique(xy[0], axis=0)) == 4


def test_a_file_is_made_of_such_a_file(path: Path, tmp_path: Path) -> None:
    write_onnx(path, tmp_path / "again.onnx")
    assert (tmp_path / "again.onnx").read_bytes() == pretrained_weights().read_bytes()
    write_onnx(path, tmp_path / "fewer.onnx", OnnxOptions(max_keypoints=7))
    write_onnx("default", tmp_path / "expected.onnx", OnnxOptions(max_keypoints=7))
    assert (tmp_path / "fewer.onnx").read_bytes() == (tmp_path / "expected.onnx").read_bytes()
