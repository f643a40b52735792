from __future__ import annotations

import pytest

from deepdetect import DeepDetect, OptionError
from deepdetect.detector.pretrained import PRETRAINED, pretrained_weights


@pytest.mark.parametrize("name", PRETRAINED)
def test_every_name_has_its_file(name: str) -> None:
    path = pretrained_weights(name)
    assert 1e5 < path.stat().st_size < 2e6


def test_the_names_stand_for_different_weights() -> None:
    assert len({pretrained_weights(name).read_bytes() for name in PRETRAINED}) == len(PRETRAINED)
    assert DeepDetect().weights == DeepDetect("default").weights == pretrained_weights()
    assert DeepDetect("dense").weights == pretrained_weights("dense")


def test_an_unknown_name_says_the_nearest() -> None:
    with pytest.raises(OptionError, match="'dense'"):
        DeepDetect("densee")
