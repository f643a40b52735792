from __future__ import annotations

import numpy as np
import pytest

from deepdetect.datasets.middlebury import StereoPair
from deepdetect.evaluation.protocols.masks import LabelDetector
from deepdetect.evaluation.protocols.stereo_matches import score_stereo_matches


@pytest.fixture
def shifted_pair(photo: np.ndarray) -> StereoPair:
    """A photograph and itself, moved by 6 pixels: the truth is exact."""
    left, right = photo[:100, :194], photo[:100, 6:200]
    return StereoPair("moved", left, right, np.full(left.shape[:2], 6.0, np.float32))


@pytest.mark.slow
def test_each_source_is_beside_its_chance_level(shifted_pair: StereoPair) -> None:
    pair = shifted_pair
    rows = score_stereo_matches({"labels": LabelDetector()}, [pair, pair])
    sources = ("labels", "random, as labels", "all pixels")
    assert [row["source"] for row in rows] == [source for source in sources for _ in range(2)]
    labels, _, chance, _, every, _ = rows
    assert chance["density"] == pytest.approx(labels["density"], abs=0.001)
    assert every["density"] == 1
    assert labels["precision"] > 0.9
    assert chance["precision"] < labels["precision"]
    assert labels["score"]["evaluated"] == labels["score"]["matches"]
    wrong = StereoPair(pair.name, pair.left, pair.right, pair.disparity + 3)
    found = score_stereo_matches({"labels": LabelDetector()}, [wrong])
    assert found[0]["precision"] < 0.1
    assert found[0]["score"]["matches"] == labels["score"]["matches"]
