"""The graph of an ONNX file: padding and cropping, a fixed size, metadata.

It needs the package `onnx` but not torch: files are made from files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ... import __version__
from ..pretrained import LOGITS, PADDED_IMAGE, STRIDE

if TYPE_CHECKING:
    from onnx import GraphProto, ModelProto, NodeProto

IMAGE, PROBABILITY, PADDED_LOGITS = "image", "probability", "padded_logits"
"""Names of tensors; the network itself maps `PADDED_IMAGE` to `PADDED_LOGITS`."""

_OUTSIDE = {"shape", "sides", "minus_sides", "missing", "padding", PADDED_IMAGE}
_OUTSIDE |= {"sigmoid", PROBABILITY, LOGITS}
"""Names of tensors that are computed outside the network itself."""

METADATA = {
    "channels": "RGB",
    "range": "0 to 1",
    "stride": str(STRIDE),
    "padding": "inside: the last row and column are repeated up to the stride, the maps cropped",
    "pixel_origin": "x right, y down, the centre of the first pixel is (0, 0)",
    "producer": "deepdetect",
}
"""Metadata of every file, in addition to version, weights, licence and size."""

_FACTOR_SHAPES = {"Conv": (-1, 1, 1, 1), "ConvTranspose": (-1, 1, 1)}
"""Shape of a factor per output channel that scales a kernel, by type of convolution."""


def add_padding(model: ModelProto) -> None:
    """Extend a network from `image` to `logits`: accept any size, and also output probabilities.

    The image's last row and column are repeated up to multiples of 8, and the maps are cropped, as
    in `compute_maps`. Probabilities are at most 1. Batch normalisation is folded.
    """
    from onnx import helper

    graph = model.graph
    fold_normalisation(graph)
    give_four_dimensions(graph)
    rest = list(graph.node)
    for node in rest:
        rename(node, IMAGE, PADDED_IMAGE)
        rename(node, LOGITS, PADDED_LOGITS)
    add_constants(graph, {"first_side": [2], "end_of_sides": [4], "side_axis": [0]})
    add_constants(graph, {"stride": [STRIDE], "no_padding": [0] * 6})
    before = [
        helper.make_node("Shape", [IMAGE], ["shape"]),
        helper.make_node("Slice", ["shape", "first_side", "end_of_sides", "side_axis"], ["sides"]),
        helper.make_node("Neg", ["sides"], ["minus_sides"]),
        helper.make_node("Mod", ["minus_sides", "stride"], ["missing"]),
        helper.make_node("Concat", ["no_padding", "missing"], ["padding"], axis=0),
        helper.make_node("Pad", [IMAGE, "padding"], [PADDED_IMAGE], mode="edge"),
    ]
    replace_nodes(graph, [*before, *rest, *_ending(graph)])
    graph.output.insert(0, graph.output[0])
    graph.output[0].name = PROBABILITY
    _set_sides(graph, "dim_param", batch="batch", height="height", width="width")


def fix_size(model: ModelProto, height: int, width: int, batch: int) -> None:
    """Give a network with padding one size, and remove the nodes that compute it."""
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
    replace_nodes(graph, [*before, *inner, *_ending(graph, crop=bool(below or right))])
    _set_sides(graph, "dim_value", batch=batch, height=height, width=width)


def write_metadata(model: ModelProto, values: Mapping[str, str]) -> None:
    """Replace a file's metadata by `values`, `METADATA` and the version of this package."""
    from onnx import helper

    written = {**METADATA, "version": __version__, **values}
    helper.set_model_props(model, dict(sorted(written.items())))
    # OpenCV 4 averages correctly at the border only with this producer name.
    model.producer_name = "pytorch"
    model.graph.name = "deepdetect"


def read_metadata(model: ModelProto) -> dict[str, str]:
    """Return a file's metadata."""
    return {one.key: one.value for one in model.metadata_props}


def _ending(graph: GraphProto, crop: bool = True) -> list[NodeProto]:
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
        # Some runtimes approximate the sigmoid by up to 1.0000001.
        helper.make_node("Clip", ["sigmoid", "least", "most"], [PROBABILITY]),
    ]


def _set_sides(graph: GraphProto, kind: str, **sides: str | int) -> None:
    """Write the batch, height and width of the image and the maps."""
    for value in (*graph.input, *graph.output):
        dimensions = value.type.tensor_type.shape.dim
        for axis, name in ((0, "batch"), (2, "height"), (3, "width")):
            setattr(dimensions[axis], kind, sides[name])


def fold_normalisation(graph: GraphProto) -> None:
    """Fold batch normalisation into the preceding convolution, or into a factor and an offset.

    It is computed in float64, so that the same weights give the same numbers everywhere: PyTorch's
    exporter rounds differently on different processors. Convolutions must not have a bias yet.
    """
    from onnx import helper, numpy_helper

    values = {one.name: one for one in graph.initializer}
    made = {name: node for node in graph.node for name in node.output}
    for node in graph.node:
        if node.op_type == "Identity" and node.input[0] in values:  # equal weights stored once
            values[node.output[0]] = values[node.input[0]]
    folded: list[NodeProto] = []
    for node in graph.node:
        if node.op_type != "BatchNormalization":
            folded.append(node)
            continue
        weight, bias, mean, variance = (
            numpy_helper.to_array(values[name]).astype(np.float64) for name in node.input[1:]
        )
        epsilon = next(one.f for one in node.attribute if one.name == "epsilon")
        factor = weight / np.sqrt(variance + epsilon)
        offset = bias - mean * factor
        source, target = node.input[0], node.output[0]
        before = made[source]
        if before.op_type in _FACTOR_SHAPES:
            name = before.input[1]
            shape = _FACTOR_SHAPES[before.op_type]
            kernel = numpy_helper.to_array(values[name]) * factor.reshape(shape)
            arrays = {f"{name}.folded": kernel, f"{name}.bias": offset}
            before.input[:] = [before.input[0], *arrays]
            for other in graph.node:  # `tiling` uses the names of PyTorch's exporter
                rename(other, target, source)
        else:
            both = {f"{target}.factor": factor, f"{target}.offset": offset}
            arrays = {name: array[:, None, None] for name, array in both.items()}
            product = f"{target}.product"
            folded.append(helper.make_node("Mul", [source, f"{target}.factor"], [product]))
            folded.append(helper.make_node("Add", [product, f"{target}.offset"], [target]))
        add_constants(graph, arrays, np.float32)
    replace_nodes(graph, folded)


def give_four_dimensions(graph: GraphProto) -> None:
    """Store numbers per channel as (1, C, 1, 1) instead of the equivalent (C, 1, 1).

    For three dimensions OpenVINO transposes the image before and after each sum, product or PReLU
    with such a constant, which took a third of the time.
    """
    from onnx import numpy_helper

    used = {
        name
        for node in graph.node
        if node.op_type in ("Add", "Mul", "PRelu")
        for name in node.input
    }
    for one in graph.initializer:
        if one.name in used and len(one.dims) == 3 and list(one.dims[1:]) == [1, 1]:
            values = numpy_helper.to_array(one)
            one.CopyFrom(numpy_helper.from_array(values[None], one.name))


def replace_nodes(graph: GraphProto, nodes: Sequence[NodeProto]) -> None:
    """Replace all nodes, and drop the weights that none of them reads."""
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
    """Add small constants, replacing those of the same name."""
    from onnx import numpy_helper

    others = [one for one in graph.initializer if one.name not in values]
    added = [numpy_helper.from_array(np.array(value, kind), name) for name, value in values.items()]
    del graph.initializer[:]
    graph.initializer.extend([*others, *added])
