from __future__ import annotations

import pickle

import pytest

from deepdetect._shared.errors import (
    BatchError,
    DeepDetectError,
    ImageError,
    MissingExtraError,
    OptionError,
    WeightsError,
    unknown_name,
)

PROVIDERS = (
    "TensorrtExecutionProvider",
    "CUDAExecutionProvider",
    "OpenVINOExecutionProvider",
    "RknpuExecutionProvider",
    "AzureExecutionProvider",
    "CPUExecutionProvider",
)


@pytest.mark.parametrize("kind", [ImageError, MissingExtraError, OptionError, WeightsError])
def test_every_error_is_a_deepdetect_error(kind: type[Exception]) -> None:
    assert issubclass(kind, DeepDetectError)


@pytest.mark.parametrize(
    ("given", "known", "meant"),
    [
        ("siift", ("sift", "orb"), "sift"),
        ("SIFT", ("sift", "orb"), "sift"),
        ("shi_tomasi", ("shi-tomasi", "sift"), "shi-tomasi"),
        ("onnx", ("auto", "onnxruntime", "openvino", "torch"), "onnxruntime"),
        # Names with capitals: the nearest one is found without regard to case.
        ("CUDAExecutionProvidr", PROVIDERS, "CUDAExecutionProvider"),
        ("cudaexecutionprovider", PROVIDERS, "CUDAExecutionProvider"),
        ("CpuExecutionProvider", PROVIDERS, "CPUExecutionProvider"),
        ("openvinoexecutionprovider", PROVIDERS, "OpenVINOExecutionProvider"),
    ],
)
def test_unknown_name_names_the_nearest(given: str, known: tuple[str, ...], meant: str) -> None:
    error = unknown_name("thing", given, known)
    assert isinstance(error, OptionError)
    assert f"unknown thing {given!r}" in str(error)
    assert f"did you mean {meant!r}?" in str(error)
    assert ", ".join(known) in str(error)


@pytest.mark.parametrize("given", ["zzz", "", None, 3])
def test_unknown_name_without_a_near_one_lists_the_known(given: object) -> None:
    message = str(unknown_name("thing", given, iter(["sift", "orb"])))
    assert "did you mean" not in message
    assert "sift, orb" in message
    assert repr(given) in message


def test_the_failures_of_many_files_survive_pickling() -> None:
    error = pickle.loads(pickle.dumps(BatchError("2 of 3 failed", ["a.png: b", "c.png: d"])))
    assert str(error) == "2 of 3 failed; the first: a.png: b"
    assert error.failures == ("a.png: b", "c.png: d")
