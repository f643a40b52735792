from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect.detector.backends.onnx_parts import cut_onnx, leave_out_outputs
from deepdetect.detector.pretrained import POINTS, pretrained_weights

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


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file that gives points, too."""
    pytest.importorskip("onnx", reason="needs onnx, which is for exporting only")
    from deepdetect.detector.network.onnx_export import write_onnx

    made = tmp_path_factory.mktemp("made") / "points.onnx"
    write_onnx("default", made)
    return made


def test_outputs_are_left_out_with_what_computes_them_only(path: Path) -> None:
    import onnx

    model = path.read_bytes()
    image = np.random.default_rng(0).random((2, 3, 41, 50), np.float32)
    part = leave_out_outputs(model, {*POINTS, "none"})
    found, whole = onnx.load_from_string(part), onnx.load_from_string(model)
    onnx.checker.check_model(found, full_check=True)
    assert list(found.graph.input) == list(whole.graph.input)
    assert list(found.graph.output) == list(whole.graph.output)[:2]
    assert {node.op_type for node in whole.graph.node} >= {"TopK", "Loop"}
    assert {node.op_type for node in found.graph.node}.isdisjoint({"TopK", "Loop"})
    assert len(part) < 1.01 * len(MODEL)
    assert list(found.metadata_props) == list(whole.metadata_props)
    for one, other in zip(run(part, image=image), run(MODEL, image=image), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)


def test_the_package_computes_maps_only(path: Path) -> None:
    from deepdetect.detector.backends.interface import RuntimeOptions
    from deepdetect.detector.backends.onnxruntime_backend import open_onnxruntime

    network = open_onnxruntime(path, RuntimeOptions())
    names = [value.name for value in network._session.get_outputs()]
    assert names == ["probability", "logits"]
