from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect.detector.backends.onnx_parts import cut_onnx
from deepdetect.detector.pretrained import pretrained_weights

MODEL = pretrained_weights().read_bytes()
HALF = "/network/encoder/b1/act/PRelu_output_0"


def run(model: bytes, **given: np.ndarray) -> list[np.ndarray]:
    import onnxruntime

    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    names = [value.name for value in session.get_inputs()]
    return session.run(None, dict(zip(names, given.values(), strict=True)))


def test_the_parts_one_after_the_other_are_the_whole() -> None:
    image = np.random.default_rng(0).random((1, 3, 40, 64), np.float32)
    _, expected = run(MODEL, image=image)
    (half,) = run(cut_onnx(MODEL, ["image"], [HALF]), image=image)
    assert half.shape == (1, 19, 20, 32)
    (found,) = run(cut_onnx(MODEL, ["image", HALF], ["logits"]), image=image, half=half)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    (of_another,) = run(cut_onnx(MODEL, ["image", HALF], ["logits"]), image=image, half=-half)
    assert np.abs(of_another - expected).max() > 1


def test_a_part_is_a_valid_file_with_what_it_needs(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    part = cut_onnx(MODEL, ["image"], [HALF])
    assert len(part) < len(MODEL) / 50
    model = onnx.load_from_string(part)
    onnx.checker.check_model(model)
    assert [value.name for value in model.graph.input] == ["image"]
    assert [value.name for value in model.graph.output] == [HALF]


@pytest.mark.parametrize(("inputs", "outputs"), [(["image"], ["none"]), ([HALF], ["logits"])])
def test_tensors_that_are_missing(inputs: list[str], outputs: list[str]) -> None:
    with pytest.raises(KeyError):
        cut_onnx(MODEL, inputs, outputs)
