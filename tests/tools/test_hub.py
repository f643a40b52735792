"""Folders for model hubs hold weights that load, and cards whose links lead to the repository."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetect, OptionError, WeightsError
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
    with pytest.raises(OptionError, match="did you mean 'device'"):
        DeepDetect.from_pretrained(hub / f"deepdetect-{name}", devices="cpu")


def test_cards_and_configs(hub: Path) -> None:
    folders = sorted(hub.iterdir())
    assert len(folders) == len(PRETRAINED) + 2
    for folder in folders:
        assert json.loads((folder / "config.json").read_text())["library"] == "deepdetect"
        text = (folder / "README.md").read_text("utf-8")
        assert text.startswith("---\nlicense: mit\n")
        for link in re.findall(r"\]\(([^)\s]+)\)", text):
            assert link.startswith(("https://", "#"))
            page = re.fullmatch(
                r"https://github\.com/deepdetect/deepdetect/blob/v[^/]+/([^#]+).*", link
            )
            assert page is None or (ROOT / page[1]).exists(), link
