from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import onnxruntime
import pytest

from deepdetect import DeepDetect
from deepdetect._shared.errors import OptionError
from deepdetect.detector.backends.interface import RuntimeOptions
from deepdetect.detector.backends.onnxruntime_backend import open_onnxruntime
from deepdetect.detector.pretrained import pretrained_weights

CUDA = RuntimeOptions("onnxruntime", "cuda")


@pytest.fixture
def broken_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in for a build with CUDA whose libraries are missing."""
    session = onnxruntime.InferenceSession

    def start(path: str, *args: Any, providers: Sequence[str], **named: Any) -> Any:
        if any("CUDAExecutionProvider" in provider for provider in providers):
            raise RuntimeError("CUDA failure 35: driver is insufficient\nsecond line")
        return session(path, *args, providers=providers, **named)

    known = ["CUDAExecutionProvider", "CPUExecutionProvider"]
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: known)
    monkeypatch.setattr(onnxruntime, "InferenceSession", start)


def test_a_device_that_cannot_start_is_no_damaged_file(broken_cuda: None) -> None:
    with pytest.raises(OptionError, match="CUDA failure 35"):
        open_onnxruntime(pretrained_weights().read_bytes(), CUDA)


def test_memory_that_was_given_back_changes_no_answer() -> None:
    network: Any = DeepDetect(backend="onnxruntime", threads=1)._network
    image = np.random.default_rng(0).random((1, 3, 64, 96), np.float32)
    before = network(image)
    network.release_memory()
    np.testing.assert_array_equal(network(image), before)
