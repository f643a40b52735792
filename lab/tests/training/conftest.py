from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from skimage import data

from deepdetect_lab.training import PRESETS, TrainingOptions


def plain_options(**values: Any) -> TrainingOptions:
    """The recipe of ESPNet, whose views are but scaled and cropped, with other values."""
    return dataclasses.replace(PRESETS["espnet"], **values)


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    """Let torch use one thread: networks are small here, and the processor is shared."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of twelve small real photographs, cut from scikit-image's."""
    folder = tmp_path_factory.mktemp("photographs")
    k = 0
    for image in (data.astronaut(), data.chelsea(), data.coffee()):
        for top, left in ((0, 0), (120, 40), (60, 200), (140, 240)):
            crop = np.ascontiguousarray(image[top : top + 128, left : left + 144])
            Image.fromarray(crop).save(folder / f"photo{k:02d}.png")
            k += 1
    return folder


def texture(seed: int, side: int) -> np.ndarray:
    """A picture of random blobs of all sizes, (S, S) uint8."""
    generator = np.random.default_rng(seed)
    layers = [
        cv2.GaussianBlur(generator.standard_normal((side, side)), (0, 0), sigma) * sigma
        for sigma in (1.0, 2, 4, 8)
    ]
    total = np.sum(layers, axis=0)
    return np.uint8(255 * (total - total.min()) / np.ptp(total))


@pytest.fixture(scope="session")
def textures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of four such pictures."""
    folder = tmp_path_factory.mktemp("textures")
    for k in range(4):
        cv2.imwrite(str(folder / f"{k}.png"), texture(k, 480))
    return folder
