"""The weights of the paper's authors as `DeepDetect` takes them."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from deepdetect_lab.networks.export import export_onnx
from deepdetect_lab.networks.weights import load_network


@pytest.fixture(scope="session")
def published(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Convert the weights for "matching" or for "reconstruction" to ONNX."""
    folder = tmp_path_factory.mktemp("published")

    @cache
    def convert(name: str) -> Path:
        network = load_network(shared / "reference" / f"published_{name}.safetensors")
        export_onnx(network, folder / f"{name}.onnx")
        return folder / f"{name}.onnx"

    return convert
