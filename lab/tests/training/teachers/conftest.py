from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from deepdetect_lab.networks.export import to_onnx
from deepdetect_lab.training.teachers.aliked import Aliked
from deepdetect_lab.training.teachers.readings import Teachers


class EdgePoint(nn.Module):
    """A network with the inputs and outputs of EdgePoint2; its first feature is the image."""

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Conv2d(1, 64, 4, 4)
        nn.init.ones_(self.features.bias)
        with torch.no_grad():
            self.features.weight[0] = 1
            self.features.bias[0] = 0

    def forward(self, image: Tensor) -> Tensor:
        features: Tensor = self.features(image)
        return features


@pytest.fixture(scope="session")
def teacher_files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Random weights of both teachers: an ONNX file, and a file of torch."""
    folder = tmp_path_factory.mktemp("teachers")
    torch.manual_seed(5)
    axes = {2: "height", 3: "width"}
    shapes = dict.fromkeys(("image", "descriptors"), axes)
    model = to_onnx(EdgePoint(), {"image": torch.zeros(1, 1, 64, 96)}, ("descriptors",), shapes)
    (folder / "edgepoint.onnx").write_bytes(model.SerializeToString())
    torch.save(Aliked().state_dict(), folder / "aliked.pth")
    return folder / "edgepoint.onnx", folder / "aliked.pth"


@pytest.fixture(scope="session")
def teachers(teacher_files: tuple[Path, Path]) -> Teachers:
    return Teachers(*teacher_files)
