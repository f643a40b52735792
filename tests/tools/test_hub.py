"""Folders for model hubs hold weights that load."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetect, WeightsError
from deepdetect.detector.pretrained import PRETRAINED

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def hub(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("hatchling", reason="needs hatchling, which builds the wheel")
    folder = tmp_path_factory.mktemp("hub") / "hub"
    subprocess.run([sys.executable, ROOT / "tools/hub", folder], check=True)
    return folder


@pytest.mark.parametrize("name", PRETRAINED)
def test_a_folder_gives_what_the_name_gives(name: str, hub: Path, photo: np.ndarray) -> None:
    found = DeepDetect.from_pretrained(hub / f"deepdetect-{name}")
    np.testing.assert_array_equal(found.heatmap(photo), DeepDetect(name).heatmap(photo))
    with pytest.raises(WeightsError):
        DeepDetect.from_pretrained(hub)
