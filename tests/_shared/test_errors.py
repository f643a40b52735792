from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import deepdetect
from deepdetect._shared.errors import (
    DeepDetectError,
    ImageError,
    InvalidFileError,
    MissingCalibrationError,
    MissingExtraError,
    MissingFileError,
    MissingImageError,
    MissingWeightsError,
    OptionError,
    ReconstructionError,
    RegistrationError,
    WeightsError,
    first_line,
    unknown_name,
)


@pytest.mark.parametrize(
    ("given", "known", "meant"),
    [
        ("siift", ("sift", "orb"), "sift"),
        ("onnx", ("auto", "onnxruntime", "openvino", "torch"), "onnxruntime"),
        # The nearest one is found without regard to case.
        ("cudaexecutionprovidr", ("CPUExecutionProvider", "CUDAExecutionProvider"), "CUDAExec"),
    ],
)
def test_unknown_name_names_the_nearest(given: str, known: tuple[str, ...], meant: str) -> None:
    error = unknown_name("thing", given, known)
    assert isinstance(error, OptionError)
    assert f"'{meant}" in str(error)


@pytest.mark.parametrize(
    ("kind", "builtin"),
    [
        (ImageError, ValueError),
        (OptionError, ValueError),
        (WeightsError, ValueError),
        (ReconstructionError, ValueError),
        (RegistrationError, ValueError),
        (InvalidFileError, ValueError),
        (MissingExtraError, ImportError),
        (MissingFileError, FileNotFoundError),
        (MissingImageError, FileNotFoundError),
        (MissingImageError, ImageError),
        (MissingWeightsError, FileNotFoundError),
        (MissingWeightsError, WeightsError),
        (MissingCalibrationError, FileNotFoundError),
        (MissingCalibrationError, ReconstructionError),
    ],
)
def test_errors_are_the_built_in_ones_too(
    kind: type[DeepDetectError], builtin: type[Exception]
) -> None:
    error = kind("there is no file x: check the path")
    assert isinstance(error, builtin)
    assert str(error) == "there is no file x: check the path"
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is kind
    assert str(copy) == str(error)


@pytest.mark.parametrize(
    ("error", "line"),
    [(ValueError(" a\nb"), "a"), (ValueError(), "ValueError"), (KeyError("\n"), "'\\n'")],
)
def test_the_first_line_of_an_error_is_never_missing(error: Exception, line: str) -> None:
    assert first_line(error) == line


def missing_files() -> dict[str, Callable[[Path], object]]:
    image = np.zeros((32, 32), np.uint8)
    return {
        "image": deepdetect.load_image,
        "weights": deepdetect.DeepDetect,
        "ranker": lambda path: deepdetect.PointDetector(ranker=path),
        "keypoints": deepdetect.load_keypoints,
        "matches": deepdetect.load_matches,
        "match_images": lambda path: deepdetect.match_images(path, path),
        "disparity_map": lambda path: deepdetect.disparity_map(path, path),
        "stitch": lambda path: deepdetect.stitch([path, path]),
        "calibration": lambda path: deepdetect.reconstruct(image, image, calibration=path),
    }


@pytest.mark.parametrize("name", missing_files())
def test_a_missing_file_is_a_file_not_found_error(name: str, tmp_path: Path) -> None:
    path = tmp_path / "missing.onnx"
    with pytest.raises(FileNotFoundError) as caught:
        missing_files()[name](path)
    assert isinstance(caught.value, DeepDetectError)
