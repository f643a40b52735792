"""The keypoints of `PointDetector` as ONNX outputs; `tools/points_graph.py` makes their graph."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..points.descriptor import DESCRIPTOR_GRAPHS, descriptor_type
from ..pretrained import DESCRIBING, DESCRIPTORS, MAX_KEYPOINTS, POINTS, POINTS_GRAPH, PREFIX
from .graph import replace_nodes

if TYPE_CHECKING:
    from onnx import GraphProto, ModelProto


def add_points(model: ModelProto, max_keypoints: int, descriptor: str | Path | None = None) -> None:
    """Let a model with the input `image` also output the keypoints of `PointDetector`.

    `keypoints` are (batch, N, 2) float32, x and y in pixels, best first; `scores`, `sizes` and
    `angles` are (batch, N) float32. If an image has fewer keypoints, the other rows are -1 in
    `keypoints` and 0 in the other outputs. With a descriptor, `descriptors` are (batch, N, 64).
    """
    import onnx

    points = onnx.load_model_from_string(POINTS_GRAPH.read_bytes()).graph
    count = onnx.numpy_helper.from_array(np.array([max_keypoints]), MAX_KEYPOINTS)
    for constant in points.initializer:
        if constant.name == MAX_KEYPOINTS:
            constant.CopyFrom(count)
    if descriptor is None:
        _remove(points, (DESCRIBING, DESCRIPTORS))
    else:
        _describe(points, descriptor)
    for output in points.output:
        sides = output.type.tensor_type.shape.dim
        sides[0].CopyFrom(model.graph.input[0].type.tensor_type.shape.dim[0])
        sides[1].dim_value = max_keypoints
    model.graph.node.extend(points.node)
    model.graph.initializer.extend(points.initializer)
    model.graph.output.extend(points.output)


def remove_points(model: ModelProto) -> None:
    """Remove the nodes and outputs that `add_points` has added."""
    _remove(model.graph, (PREFIX, *POINTS, DESCRIBING, DESCRIPTORS))


def _remove(graph: GraphProto, starts: tuple[str, ...]) -> None:
    """Remove the nodes and outputs whose names start with one of `starts`."""
    kept = [value for value in graph.output if not value.name.startswith(starts)]
    nodes = [node for node in graph.node if not node.output[0].startswith(starts)]
    del graph.output[:]
    graph.output.extend(kept)
    replace_nodes(graph, nodes)


def _describe(points: GraphProto, descriptor: str | Path) -> None:
    """Insert the network of a descriptor between the nodes that give and take its tensors."""
    import onnx

    descriptor_type(descriptor)  # raises an error if the file is no descriptor
    network = onnx.load(DESCRIPTOR_GRAPHS.get(str(descriptor), Path(descriptor))).graph
    onnx.compose.add_prefix_graph(network, DESCRIBING, inplace=True)
    own = f"{DESCRIBING}descriptors"
    first = next(k for k, node in enumerate(points.node) if own in node.input)
    nodes = [*points.node[:first], *network.node, *points.node[first:]]
    points.initializer.extend(network.initializer)
    replace_nodes(points, nodes)
