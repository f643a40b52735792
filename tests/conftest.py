"""Fixtures that several test modules share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import hypothesis
import numpy as np
import pytest

# The same examples on every run, no files left behind, no limit on time.
hypothesis.settings.register_profile(
    "deepdetect", deadline=None, derandomize=True, database=None, max_examples=60
)
hypothesis.settings.load_profile("deepdetect")


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of photographs and reference data beside the repository."""
    folder = Path(__file__).parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip("needs ../shared (photographs and reference data), which is not there")
    return folder


@pytest.fixture(scope="session")
def photo() -> np.ndarray:
    """A real photograph, (256, 256, 3) uint8 RGB, not to be written to."""
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    rgb = np.ascontiguousarray(data.astronaut()[::2, ::2])
    rgb.setflags(write=False)
    return rgb


@pytest.fixture
def photo_path(photo: np.ndarray, tmp_path: Path) -> Path:
    """The photograph as a PNG file."""
    from PIL import Image

    path = tmp_path / "photo.png"
    Image.fromarray(photo).save(path)
    return path


@pytest.fixture(scope="session")
def one_line() -> Callable[[BaseException], str]:
    """Return an error's message, having checked that it is one line of text."""

    def check(error: BaseException) -> str:
        message = str(error)
        assert message.strip() == message
        assert message
        assert len(message.splitlines()) == 1, message
        return message

    return check


@pytest.fixture
def run_evaluate(tmp_path: Path) -> Callable[..., str]:
    """Run `deepdetect evaluate` on one sample and return what it prints."""
    from click.testing import CliRunner
    from PIL import Image

    from deepdetect.bundled import bundled_weights
    from deepdetect.cli import main

    generator = np.random.default_rng(0)
    Image.fromarray(generator.integers(0, 256, (64, 64, 3), np.uint8)).save(
        tmp_path / "image_1.png"
    )
    Image.fromarray(generator.random((64, 64)) > 0.5).save(tmp_path / "mask_image_1.png")

    def run(*arguments: object) -> str:
        given = [bundled_weights() if str(a).endswith(".onnx") else a for a in arguments]
        result = CliRunner().invoke(main, ["evaluate", str(tmp_path), *map(str, given)])
        assert result.exit_code == 0, result.output
        return result.output

    return run
