from __future__ import annotations

import re
from pathlib import Path

import onnx
import pytest

from deepdetect.detector.onnx_files.graph import read_metadata
from deepdetect.detector.pretrained import PRETRAINED, pretrained_weights
from deepdetect_lab.networks.export import export_onnx
from deepdetect_lab.networks.weights import find_weights, load_network


@pytest.mark.parametrize("name", PRETRAINED)
def test_the_shipped_files_are_those_of_the_safetensors(name: str, tmp_path: Path) -> None:
    shipped = pretrained_weights(name)
    export_onnx(load_network(find_weights(name)), tmp_path / "made.onnx")
    made, model = onnx.load(tmp_path / "made.onnx"), onnx.load(shipped)
    for graph in (made.graph, model.graph):  # the exporter counts some of the weights
        for one in graph.initializer:
            one.name = re.sub(r"^(onnx::\w+)_\d+$", r"\1", one.name)
        for node in graph.node:
            node.input[:] = [re.sub(r"^(onnx::\w+)_\d+$", r"\1", name) for name in node.input]
    assert made.graph == model.graph
    metadata = read_metadata(model)
    assert (metadata["weights"], metadata["licence"]) == (name, "MIT")
    assert {**read_metadata(made), "weights": name, "licence": "MIT"} == {
        **metadata,
        "version": read_metadata(made)["version"],
    }
