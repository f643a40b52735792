from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect.detector.backends.onnx_parts import cut_onnx
from deepdetect.detector.pretrained import pretrained_weights

MODEL = pretrained_weights().read_bytes()
HALF = "/network/encode_half/encode_half.1/Relu_output_0"


def run(model: bytes, **given: np.ndarray) -> list[np.ndarray]:
    import onnxruntime

    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    names = [value.name for value in session.get_inputs()]
    return session.run(None, dict(zip(names, given.values(), strict=True)))


def test_the_parts_one_after_the_other_are_the_whole() -> None:
    image = np.random.default_rng(0).random((1, 3, 40, 64), np.float32)
    _, expected = run(MODEL, image=image)
    (half,) = run(cut_onnx(MODEL, ["image"], [HALF]), image=image)
    assert half.shape == (1, 16, 20, 32)
    (found,) = run(cut_onnx(MODEL, ["image", HALF], ["logits"]), image=image, half=half)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    (of_another,) = run(cut_onnx(MODEL, ["image", HALF], ["logits"]), image=image, half=-half)
    assert np.abs(of_another - expected).max() > 1


@pytest.mark.parametrize(("inputs", "outputs"), [(["image"], ["none"]), ([HALF], ["logits"])])
def test_tensors_that_are_missing(inputs: list[str], outputs: list[str]) -> None:
    with pytest.raises(KeyError):
        cut_onnx(MODEL, inputs, outputs)


def test_the_package_computes_logits_only(tmp_path: Path) -> None:
    """The points that a file also gives are not computed, because they would take time."""
    onnx = pytest.importorskip("onnx", reason="needs onnx, which is for exporting only")
    from deepdetect.detector.backends import RuntimeOptions, open_network
    from deepdetect.detector.onnx_files.export import write_onnx

    path = tmp_path / "points.onnx"
    write_onnx("default", path)
    whole = onnx.load(path)
    part = onnx.load_from_string(cut_onnx(path.read_bytes(), ["image"], ["logits"]))
    assert {node.op_type for node in whole.graph.node} >= {"TopK", "Loop"}
    assert {node.op_type for node in part.graph.node}.isdisjoint({"TopK", "Loop"})
    assert list(part.metadata_props) == list(whole.metadata_props)
    network, _ = open_network(path, RuntimeOptions())
    image = np.random.default_rng(0).random((2, 3, 40, 56), np.float32)
    np.testing.assert_allclose(network(image), run(MODEL, image=image)[1], atol=1e-4)


def test_weights_in_a_file_of_their_own(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx", reason="needs onnx, which is for exporting only")
    from deepdetect.detector.backends import RuntimeOptions, open_network

    path = tmp_path / "network.onnx"
    model = onnx.load_from_string(MODEL)
    onnx.save(model, path, save_as_external_data=True, size_threshold=100)
    assert (tmp_path / "network.onnx").stat().st_size < len(MODEL) / 2
    image = np.random.default_rng(0).random((1, 3, 40, 56), np.float32)
    network, _ = open_network(path, RuntimeOptions())
    np.testing.assert_allclose(network(image), run(MODEL, image=image)[1], atol=1e-4)
