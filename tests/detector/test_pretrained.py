from __future__ import annotations

import json
import re

import pytest

from deepdetect import DeepDetect, OptionError
from deepdetect.detector.pretrained import PRETRAINED, pretrained_weights


@pytest.mark.parametrize("name", PRETRAINED)
@pytest.mark.parametrize("suffix", [".onnx", ".safetensors"])
def test_every_name_has_its_files(name: str, suffix: str) -> None:
    path = pretrained_weights(name, suffix)
    assert path.is_file()
    assert path.suffix == suffix
    assert 1e5 < path.stat().st_size < 2e6


def test_the_names_stand_for_different_weights() -> None:
    assert len({pretrained_weights(name).read_bytes() for name in PRETRAINED}) == len(PRETRAINED)
    assert DeepDetect().weights == DeepDetect("default").weights == pretrained_weights()
    assert DeepDetect("dense").weights == pretrained_weights("dense")


def test_an_unknown_name_says_the_nearest() -> None:
    with pytest.raises(OptionError, match="'dense'"):
        DeepDetect("densee")


@pytest.mark.parametrize("name", PRETRAINED)
def test_weights_tell_where_they_come_from(name: str) -> None:
    pytest.importorskip("safetensors", reason="needs safetensors, which is for training only")
    pytest.importorskip("torch", reason="needs torch, which is for training only")
    from deepdetect.detector.network.weights import read_notes

    means, runs = [], []
    found = [read_notes(pretrained_weights(name, ".safetensors"))]
    while found:  # a mean's parts may be means
        notes = found.pop()
        (means if "parts" in notes else runs).append(notes)
        found += json.loads(notes.get("parts", "[]"))
        found += [json.loads(notes["begun_with"])] if "begun_with" in notes else []
    assert runs
    # No weights that have seen other photographs stand behind those of free licences.
    assert name != "free" or (not means and not any(" --init" in one["command"] for one in runs))
    for mean in means:
        assert re.match("deepdetect (dev )?average ", mean["command"])
    for run in runs:
        assert run["command"].startswith(("deepdetect train ", "python benchmarks/fast_network/"))
        for word in ("photographs_digest", "versions", "machine", "start", "point"):
            assert run[word]
    for one in (*means, *runs):
        assert " /" not in one["command"], "no folder of one machine"
        assert len(one["commit"]) == 40
