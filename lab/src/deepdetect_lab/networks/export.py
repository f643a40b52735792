"""Export networks from torch to ONNX files, which `deepdetect` reads."""

from __future__ import annotations

import io
import logging
import warnings
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import GraphProto, ModelProto, NodeProto, helper, numpy_helper
from torch import Tensor, nn

from deepdetect.detector.onnx_files.export import OnnxOptions, write_model
from deepdetect.detector.onnx_files.graph import (
    IMAGE,
    PROBABILITY,
    add_constants,
    ending_nodes,
    rename,
    replace_nodes,
    set_sides,
)
from deepdetect.detector.pretrained import LOGITS, PADDED_IMAGE, PADDED_LOGITS, STRIDE

OPSET = 17
"""Version of the ONNX operator set. ONNX Runtime 1.24, OpenVINO and OpenCV 4 can all read it."""

_FACTOR_SHAPES = {"Conv": (-1, 1, 1, 1), "ConvTranspose": (-1, 1, 1)}
"""Shape by node type in which factors, one for each output channel, multiply a kernel."""


def to_onnx(
    network: nn.Module,
    inputs: Mapping[str, Tensor],
    outputs: Sequence[str],
    axes: Mapping[str, Mapping[int, str]],
    training: Any = torch.onnx.TrainingMode.EVAL,
) -> onnx.ModelProto:
    """Convert a network to ONNX by tracing it with example `inputs`, which are given by name.

    For each input and each of the `outputs`, `axes` maps the numbers of its axes of variable size
    to names.
    """
    written = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the tracer
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        torch.onnx.export(
            network.cpu().eval(),
            tuple(inputs.values()),
            written,  # type: ignore[arg-type]  # annotated for the other exporter
            input_names=list(inputs),
            output_names=list(outputs),
            dynamic_axes=axes,
            opset_version=OPSET,
            dynamo=False,
            training=training,
        )
    return onnx.load_model_from_string(written.getvalue())


def export_onnx(network: nn.Module, path: str | Path) -> None:
    """Write a heat-map network, atomically, to an ONNX file that takes images of any size."""
    # "network" becomes part of the names of all tensors; `tiling` cuts the file at some of these.
    module = nn.Sequential(OrderedDict(network=network))
    axes = {0: "batch", 2: "height", 3: "width"}
    # Batch normalisations stay separate nodes here, because `add_padding` folds them in float64.
    model = to_onnx(
        module,
        {"image": torch.zeros(2, 3, 64, 96)},
        ("logits",),
        {"image": axes, "logits": axes},
        torch.onnx.TrainingMode.PRESERVE,
    )
    add_padding(model)
    write_model(model, path, OnnxOptions(max_keypoints=0), {})


def add_padding(model: ModelProto) -> None:
    """Let a network that maps `image` to `logits` take any image size and also give probabilities.

    As in `compute_maps`, the last row and column of the image are repeated until its sides are
    multiples of 8, and the maps are cropped to the size of the image. Probabilities are clipped to
    at most 1. Batch normalisation is folded into the convolutions.
    """
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
    replace_nodes(graph, [*before, *rest, *ending_nodes(graph)])
    graph.output.insert(0, graph.output[0])
    graph.output[0].name = PROBABILITY
    set_sides(graph, "dim_param", batch="batch", height="height", width="width")


def fold_normalisation(graph: GraphProto) -> None:
    """Fold each batch normalisation into the convolution before it.

    A normalisation without a convolution before it becomes a product and a sum. Folding uses
    float64, because PyTorch's exporter rounds differently on different processors. The convolutions
    must not have a bias yet.
    """
    values = {one.name: one for one in graph.initializer}
    made = {name: node for node in graph.node for name in node.output}
    for node in graph.node:
        if node.op_type == "Identity" and node.input[0] in values:  # an alias of equal weights
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
            for other in graph.node:  # `tiling` cuts at tensors named by PyTorch
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
    """Store constants with one value per channel as (1, C, 1, 1) instead of (C, 1, 1).

    If such a constant of a sum, product or PReLU has three dimensions, OpenVINO transposes the
    features before and after the operation. These transpositions took a third of its run time.
    """
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
