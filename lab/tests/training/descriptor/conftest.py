from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, relu

from deepdetect_lab.training.teachers.readings import Reading, choose_points


def made_reading(gray: np.ndarray, seed: int = 0) -> Reading:
    """Points of a picture with codes and scores at random, as if teachers had been read."""
    rng = np.random.default_rng(seed)
    xy, sizes = choose_points(gray, rng)
    codes = [rng.normal(size=(len(xy), length)) for length in (64, 128)]
    codes = [each / np.linalg.norm(each, axis=1, keepdims=True) for each in codes]
    scores = rng.random(len(xy))
    numbers = (values.astype(np.float32) for values in (xy, sizes))
    halves = (values.astype(np.float16) for values in (np.hstack(codes), scores))
    return Reading(gray, *numbers, *halves)


@pytest.fixture(scope="session")
def made_readings(textures: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of made readings of all textures but one."""
    folder = tmp_path_factory.mktemp("readings")
    for k, path in enumerate(sorted(textures.glob("*.png"))[:-1]):
        reading = made_reading(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), k)
        np.savez(folder / f"{path.stem}.npz", **reading._asdict())
    return folder


def layer(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> list[nn.Module]:
    return [
        nn.Conv2d(inputs, outputs, kernel, stride, 1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(),
    ]


class Block(nn.Module):
    """EdgePoint2's residual layer, with its authors' names."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.layer = nn.Sequential(*layer(inputs, outputs), *layer(outputs, outputs)[:2])
        self.skip = nn.Identity() if inputs == outputs else nn.Conv2d(inputs, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        result: Tensor = self.layer(x) + self.skip(x)
        return result


class Published(nn.Module):
    """EdgePoint2-L64's backbone, with its authors' names."""

    def __init__(self) -> None:
        super().__init__()
        first, second = (nn.Module() for _ in range(2))
        first.layer = nn.Sequential(*layer(1, 8, 4, 2))
        second.layer = nn.Sequential(*layer(8, 16))
        self.block1 = nn.ModuleList([first, second, Block(16, 16)])
        self.block2, self.block3 = Block(16, 48), Block(48, 64)

    def forward(self, luma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x = nn.InstanceNorm2d(1)(luma)
        for each in self.block1[:2]:
            x = each.get_submodule("layer")(x)
        quarter = relu(avg_pool2d(self.block1[2](x), 2))
        eighth = relu(self.block2(avg_pool2d(quarter, 2)))
        return quarter, eighth, relu(self.block3(avg_pool2d(eighth, 4)))


@pytest.fixture(scope="session")
def published() -> Published:
    """EdgePoint2-L64's backbone with random weights."""
    torch.manual_seed(0)
    network = Published()
    network(torch.rand(3, 1, 64, 96))  # running statistics
    return network.eval()


@pytest.fixture(scope="session")
def l64(published: Published, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of the weights of `published`."""
    path = tmp_path_factory.mktemp("published") / "L64.pth"
    torch.save(published.state_dict(), path)
    return path
