"""Inputs that once were read wrongly, crashed or hung: each is read or refused as its folder says.

They are in fuzz/corpus/READER/read and fuzz/corpus/READER/refused.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepdetect import DeepDetectError, load_image, load_keypoints
from deepdetect.geometry.camera import Calibration
from deepdetect.io.masks import load_mask
from deepdetect_lab.labels import find_label_settings

CORPUS = Path(__file__).parents[2] / "fuzz" / "corpus"
READERS: dict[str, Callable[[Path], Any]] = {
    "array": lambda path: load_image(np.load(path)),
    "calibration": lambda path: Calibration.load(path, (64, 48), (64, 48)),
    "image": load_image,
    "keypoints": load_keypoints,
    "label-settings": find_label_settings,
    "mask": load_mask,
}
FILES = sorted(path for path in CORPUS.rglob("*") if path.is_file())


def test_every_reader_has_inputs() -> None:
    assert {path.relative_to(CORPUS).parts[0] for path in FILES} == set(READERS)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(CORPUS).as_posix())
def test_it_is_read_or_refused_in_a_sentence(path: Path, one_line) -> None:
    reader, expected, _ = path.relative_to(CORPUS).parts
    if expected == "read":
        READERS[reader](path)
        return
    with pytest.raises(DeepDetectError) as caught:
        READERS[reader](path)
    one_line(caught.value)
