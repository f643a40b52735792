"""Changes to the graph of an ONNX file: padding and cropping, a fixed image size, metadata."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ... import __version__
from ..pretrained import LOGITS, PADDED_IMAGE, PADDED_LOGITS, STRIDE

if TYPE_CHECKING:
    from onnx import GraphProto, ModelProto, NodeProto

IMAGE, PROBABILITY = "image", "probability"
"""Names of tensors. The network itself maps `PADDED_IMAGE` to `PADDED_LOGITS`; the other nodes of a
file pad, crop and compute probabilities."""

_OUTSIDE = {"shape", "sides", "minus_sides", "missing", "padding", PADDED_IMAGE}
_OUTSIDE |= {"sigmoid", PROBABILITY, LOGITS}
"""Names of the tensors that the nodes for padding, cropping and the sigmoid compute."""

METADATA = {
    "channels": "RGB",
    "range": "0 to 1",
    "stride": str(STRIDE),
    "padding": "inside: the last row and column are repeated up to the stride, the maps cropped",
    "pixel_origin": "x right, y down, the centre of the first pixel is (0, 0)",
    "producer": "deepdetect",
}
"""Metadata of every file, in addition to version, weights, licence and size."""


def fix_size(model: ModelProto, height: int, width: int, batch: int) -> None:
    """Fix the batch and image size of a network, and remove the nodes that compute its padding."""
    from onnx import helper

    graph = model.graph
    below, right = -height % STRIDE, -width % STRIDE
    inner, before = [node for node in graph.node if _OUTSIDE.isdisjoint(node.output)], []
    if below or right:
        add_constants(graph, {"padding": [0] * 6 + [below, right], "sides": [height, width]})
        before = [helper.make_node("Pad", [IMAGE, "padding"], [PADDED_IMAGE], mode="edge")]
    else:
        for node in inner:
            rename(node, PADDED_IMAGE, IMAGE)
            rename(node, PADDED_LOGITS, LOGITS)
    replace_nodes(graph, [*before, *inner, *ending_nodes(graph, crop=bool(below or right))])
    set_sides(graph, "dim_value", batch=batch, height=height, width=width)


def write_metadata(model: ModelProto, values: Mapping[str, str]) -> None:
    """Replace a file's metadata by `values`, `METADATA` and the version of this package."""
    from onnx import helper

    written = {**METADATA, "version": __version__, **values}
    helper.set_model_props(model, dict(sorted(written.items())))
    # OpenCV 4 averages correctly at the border only in files with this producer name.
    model.producer_name = "pytorch"
    model.graph.name = "deepdetect"


def read_metadata(model: ModelProto) -> dict[str, str]:
    """Return the metadata of an ONNX file, by key."""
    return {one.key: one.value for one in model.metadata_props}


def ending_nodes(graph: GraphProto, crop: bool = True) -> list[NodeProto]:
    """Make the nodes that crop the logits and turn them into probabilities."""
    from onnx import helper

    add_constants(graph, {"from_zero": [0, 0], "side_axes": [2, 3]})
    add_constants(graph, {"least": 0, "most": 1}, np.float32)
    cropping = helper.make_node(
        "Slice", [PADDED_LOGITS, "from_zero", "sides", "side_axes"], [LOGITS]
    )
    return [
        *([cropping] if crop else []),
        helper.make_node("Sigmoid", [LOGITS], ["sigmoid"]),
        # Some runtimes approximate the sigmoid, which then reaches 1.0000001.
        helper.make_node("Clip", ["sigmoid", "least", "most"], [PROBABILITY]),
    ]


def set_sides(graph: GraphProto, kind: str, **sides: str | int) -> None:
    """Set batch, height and width of all maps to numbers ("dim_value") or names ("dim_param")."""
    for value in (*graph.input, *graph.output):
        dimensions = value.type.tensor_type.shape.dim
        for axis, name in ((0, "batch"), (2, "height"), (3, "width")):
            setattr(dimensions[axis], kind, sides[name])


def replace_nodes(graph: GraphProto, nodes: Sequence[NodeProto]) -> None:
    """Replace all nodes of a graph by `nodes`, and drop the weights that no node reads."""
    nodes = list(nodes)
    used = {name for node in nodes for name in node.input}
    weights = [one for one in graph.initializer if one.name in used]
    del graph.node[:], graph.initializer[:], graph.value_info[:]
    graph.node.extend(nodes)
    graph.initializer.extend(weights)


def rename(node: NodeProto, old: str, new: str) -> None:
    """Rename a tensor in the inputs and outputs of a node."""
    for names in (node.input, node.output):
        names[:] = [new if name == old else name for name in names]


def add_constants(graph: GraphProto, values: Mapping[str, Any], kind: type = np.int64) -> None:
    """Add small constants to a graph, and replace constants of the same name."""
    from onnx import numpy_helper

    others = [one for one in graph.initializer if one.name not in values]
    added = [numpy_helper.from_array(np.array(value, kind), name) for name, value in values.items()]
    del graph.initializer[:]
    graph.initializer.extend([*others, *added])
