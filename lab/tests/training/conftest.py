from __future__ import annotations

import dataclasses
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepdetect_lab.training import PRESETS, TrainingOptions


def plain_options(**values: Any) -> TrainingOptions:
    """The recipe of ESPNet, whose views are but scaled and cropped, with other values."""
    return dataclasses.replace(PRESETS["espnet"], **values)


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    """Let torch use one thread: networks are small here, and the processor is shared."""
    with suppress(ImportError):
        import torch

        torch.set_num_threads(1)


@pytest.fixture(scope="session")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of twelve small real photographs, cut from scikit-image's."""
    from PIL import Image
    from skimage import data

    folder = tmp_path_factory.mktemp("photographs")
    k = 0
    for image in (data.astronaut(), data.chelsea(), data.coffee()):
        for top, left in ((0, 0), (120, 40), (60, 200), (140, 240)):
            crop = np.ascontiguousarray(image[top : top + 128, left : left + 144])
            Image.fromarray(crop).save(folder / f"photo{k:02d}.png")
            k += 1
    return folder
