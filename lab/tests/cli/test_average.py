from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from deepdetect import DeepDetect
from deepdetect_lab.networks.weights import (
    average_weights,
    find_weights,
    load_network,
    read_notes,
    weights_digest,
)


@pytest.mark.slow
def test_the_mean_is_written_as_safetensors_and_onnx(run, tmp_path: Path, photo) -> None:
    result = run("dev", "average", "default", "default", "dense", "-o", tmp_path, "--json")
    assert result.exit_code == 0, result.output
    files = json.loads(result.output)
    parts = [find_weights(name) for name in ("default", "dense")]
    expected = average_weights([parts[0], parts[0], parts[1]])
    assert weights_digest(load_network(files["weights"])) == weights_digest(expected)
    values = json.loads(read_notes(files["weights"])["parts"])
    assert [part["sha256"] for part in values] == [
        weights_digest(load_network(parts[k])) for k in (0, 0, 1)
    ]
    assert values[2]["command"] == read_notes(parts[1])["command"]
    tensor = torch.from_numpy(photo.transpose(2, 0, 1)[None] / np.float32(255))
    with torch.inference_mode():
        logits = load_network(files["weights"])(tensor)[0, 0].numpy()
    _, exported = DeepDetect(files["onnx"]).heatmap_and_logits(photo)
    np.testing.assert_allclose(exported, logits, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("names", [["default"], ["default", "default"]])
def test_the_mean_of_equals_is_the_same(names: list[str], run, tmp_path: Path) -> None:
    assert run("dev", "average", *names, "-o", tmp_path).exit_code == 0
    own = load_network(find_weights("default"))
    assert weights_digest(load_network(tmp_path / "best.safetensors")) == weights_digest(own)


@pytest.mark.parametrize("words", [["default", "matchin"], ["default", "no.onnx"]])
def test_a_mistake_ends_with_exit_code_2_and_leaves_nothing(run, tmp_path: Path, words) -> None:
    result = run("dev", "average", *words, "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert not (tmp_path / "out").exists()


def test_files_of_another_run_are_not_written_over(run, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    trained = folder / "best.safetensors"
    trained.write_bytes(find_weights("default").read_bytes())
    before = trained.read_bytes()
    for first in (trained, "default"):
        assert run("dev", "average", first, "dense", "-o", folder).exit_code == 2
        assert [path.name for path in folder.iterdir()] == ["best.safetensors"]
        assert trained.read_bytes() == before
    assert run("dev", "average", "default", "dense", "-o", folder, "--overwrite").exit_code == 0
    assert trained.read_bytes() != before
