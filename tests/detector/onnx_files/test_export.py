"""Exported files give what the network gives, in other runtimes, at any size and at one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

onnx = pytest.importorskip("onnx", reason="needs onnx, which is for exporting only")

import cv2  # noqa: E402
import onnxruntime  # noqa: E402

from deepdetect import OptionError, WeightsError  # noqa: E402
from deepdetect.detector.backends.onnx_parts import cut_onnx  # noqa: E402
from deepdetect.detector.onnx_files.export import OnnxOptions, write_onnx  # noqa: E402
from deepdetect.detector.pretrained import pretrained_weights  # noqa: E402

SIZES = [(64, 96), (123, 157), (80, 41)]
"""Heights and widths: multiples of 8, of 8 in one direction, and of none."""


def images_of(photo: np.ndarray, height: int, width: int, batch: int) -> np.ndarray:
    """Cut (B, 3, H, W) float32 out of a photograph."""
    parts = [photo[9 * k : 9 * k + height, 5 * k : 5 * k + width] for k in range(batch)]
    return np.ascontiguousarray(np.stack(parts).transpose(0, 3, 1, 2) * np.float32(1 / 255))


def session_of(model: Path | bytes) -> onnxruntime.InferenceSession:
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads, settings.log_severity_level = 1, 4
    given = model if isinstance(model, bytes) else str(model)
    return onnxruntime.InferenceSession(given, settings, providers=["CPUExecutionProvider"])


@pytest.fixture(scope="module")
def network() -> onnxruntime.InferenceSession:
    """The network alone, without padding, of the shipped file."""
    shipped = pretrained_weights().read_bytes()
    return session_of(cut_onnx(shipped, ["padded_image"], ["padded_logits"]))


def expected_logits(network: onnxruntime.InferenceSession, images: np.ndarray) -> np.ndarray:
    height, width = images.shape[2:]
    sides = ((0, 0), (0, 0), (0, -height % 8), (0, -width % 8))
    padded = np.pad(images, sides, mode="edge")
    return network.run(None, {"padded_image": padded})[0][:, :, :height, :width]


def check_answers(logits: np.ndarray, probability: np.ndarray, expected: np.ndarray) -> None:
    assert logits.shape == probability.shape == expected.shape
    assert logits.dtype == probability.dtype == np.float32
    np.testing.assert_allclose(logits, expected, atol=1e-3)
    exact = 1 / (1 + np.exp(-expected.astype(np.float64)))
    np.testing.assert_allclose(probability, exact, atol=2e-4)
    assert probability.min() >= 0
    assert probability.max() <= 1


def test_the_probability_is_never_over_one() -> None:
    """Without the limit it is 1.0000001 at some of these."""
    shipped = pretrained_weights().read_bytes()
    given = np.linspace(-120, 120, 100_000, dtype=np.float32).reshape(1, 1, 100, -1)
    found = session_of(cut_onnx(shipped, ["logits"], ["probability"])).run(None, {"logits": given})
    assert found[0].max() == 1
    raw = session_of(cut_onnx(shipped, ["logits"], ["sigmoid"])).run(None, {"logits": given})
    np.testing.assert_array_equal(np.minimum(raw[0], 1), found[0])


def test_openvino(photo: np.ndarray, network: onnxruntime.InferenceSession) -> None:
    openvino = pytest.importorskip("openvino", reason="needs OpenVINO")
    settings = {"INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": 1}
    model = openvino.Core().compile_model(str(pretrained_weights()), "CPU", settings)
    for height, width in SIZES:
        images = images_of(photo, height, width, 2)
        found = model([images])
        check_answers(found["logits"], found["probability"], expected_logits(network, images))


@pytest.mark.skipif(cv2.__version__ < "5", reason="needs the new engine of OpenCV 5")
def test_opencv_5_at_any_size(photo: np.ndarray, network: onnxruntime.InferenceSession) -> None:
    model = cv2.dnn.readNetFromONNX(str(pretrained_weights()), cv2.dnn.ENGINE_NEW)
    for height, width in SIZES:
        images = images_of(photo, height, width, 2)
        model.setInput(images)
        logits, probability = model.forward(["logits", "probability"])
        check_answers(logits, probability, expected_logits(network, images))


NAMES = ["ENGINE_CLASSIC", "ENGINE_NEW"] if cv2.__version__ >= "5" else []
ENGINES = [[getattr(cv2.dnn, name)] for name in NAMES] or [[]]
"""OpenCV 4 has one engine, the classic one of OpenCV 5."""


@pytest.mark.parametrize(("size", "batch"), [((64, 96), 1), ((123, 157), 2), ((17, 23), 1)])
def test_opencv_at_one_size(
    size: tuple[int, int],
    batch: int,
    tmp_path: Path,
    photo: np.ndarray,
    network: onnxruntime.InferenceSession,
) -> None:
    path = tmp_path / "one.onnx"
    write_onnx("default", path, OnnxOptions(size, batch, max_keypoints=0))
    model = onnx.load(path)
    onnx.checker.check_model(model, full_check=True)
    assert "Shape" not in {node.op_type for node in model.graph.node}
    images = images_of(photo, *size, batch)
    for engine in ENGINES:
        net = cv2.dnn.readNetFromONNX(str(path), *engine)
        net.setInput(images)
        check_answers(*net.forward(["logits", "probability"]), expected_logits(network, images))


def test_normalisation_is_folded_and_numbers_for_each_channel_have_four_dimensions() -> None:
    graph = onnx.load(pretrained_weights("espnet")).graph
    assert "BatchNormalization" not in {node.op_type for node in graph.node}
    dimensions = {one.name: list(one.dims) for one in graph.initializer}
    shapes = [
        dimensions[each]
        for node in graph.node
        if node.op_type in ("Add", "Mul", "PRelu")
        for each in node.input
        if each in dimensions
    ]
    assert not [each for each in shapes if len(each) == 3]
    assert sum(len(each) == 4 and each[1] > 1 for each in shapes) > 20


def test_metadata(tmp_path: Path) -> None:
    found = write_onnx("default", tmp_path / "one.onnx", OnnxOptions((48, 64)), licence="CC0")
    read = session_of(tmp_path / "one.onnx").get_modelmeta().custom_metadata_map
    assert read == found
    expected = {"channels": "RGB", "range": "0 to 1", "stride": "8"}
    assert read.items() >= {**expected, "licence": "CC0", "size": "48x64"}.items()


@pytest.mark.parametrize(
    "values",
    [
        {"batch": 2},
        {"size": (4, 64)},
        {"size": (64,)},
        {"size": (64, 64), "batch": 0},
    ],
)
def test_options_are_checked(values: dict[str, object]) -> None:
    with pytest.raises(OptionError):
        OnnxOptions(**values)


def test_a_changed_file_is_not_changed_again(tmp_path: Path) -> None:
    write_onnx("default", tmp_path / "one.onnx", OnnxOptions((64, 64)))
    with pytest.raises(WeightsError, match="size 64x64"):
        write_onnx(tmp_path / "one.onnx", tmp_path / "again.onnx")
    assert not (tmp_path / "again.onnx").exists()
