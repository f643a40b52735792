"""The keypoints of `PointDetector` as ONNX outputs; `tools/points_graph.py` makes their graph."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..pretrained import MAX_KEYPOINTS, POINTS, POINTS_GRAPH, PREFIX
from .graph import replace_nodes

if TYPE_CHECKING:
    from onnx import ModelProto


def add_points(model: ModelProto, max_keypoints: int) -> None:
    """Let a model with the input `image` also output the keypoints of `PointDetector`.

    `keypoints` are (batch, N, 2) float32, x and y in pixels, best first; `scores`, `sizes` and
    `angles` are (batch, N) float32. If an image has fewer keypoints, the other rows are -1 in
    `keypoints` and 0 in the other outputs.
    """
    import onnx

    points = onnx.load_model_from_string(POINTS_GRAPH.read_bytes()).graph
    count = onnx.numpy_helper.from_array(np.array([max_keypoints]), MAX_KEYPOINTS)
    for constant in points.initializer:
        if constant.name == MAX_KEYPOINTS:
            constant.CopyFrom(count)
    for output in points.output:
        sides = output.type.tensor_type.shape.dim
        sides[0].CopyFrom(model.graph.input[0].type.tensor_type.shape.dim[0])
        sides[1].dim_value = max_keypoints
    model.graph.node.extend(points.node)
    model.graph.initializer.extend(points.initializer)
    model.graph.output.extend(points.output)


def remove_points(model: ModelProto) -> None:
    """Remove the nodes and outputs that `add_points` has added."""
    graph = model.graph
    kept = [value for value in graph.output if value.name not in POINTS]
    nodes = [node for node in graph.node if not node.output[0].startswith((PREFIX, *POINTS))]
    del graph.output[:]
    graph.output.extend(kept)
    replace_nodes(graph, nodes)
