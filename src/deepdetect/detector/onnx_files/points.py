"""The keypoints of `PointDetector` as ONNX outputs; `tools/points_graph.py` makes their graph."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...features.learned import CONSTANT, FREQUENCIES, LENGTH
from ..points.descriptor import DESCRIPTOR_GRAPHS, STRIDE, descriptor_type
from ..pretrained import GRAY, MAX_KEYPOINTS, POINTS, POINTS_GRAPH, PREFIX
from .graph import rename, replace_nodes

if TYPE_CHECKING:
    from onnx import GraphProto, ModelProto

DESCRIPTORS, DESCRIBING = "descriptors", "descriptor/"
"""The output of descriptors, and the start of the names of tensors between it and the points."""

MIRRORED = """
    {side} = Shape<start = {axis}, end = {next}>(gray)
    {side}_more = Sub({side}, one)
    {side}_last = Add({side}_more, stride)
    {side}_tiles = Div({side}_last, stride)
    {side}_padded = Mul({side}_tiles, stride)
    {side}_end = Squeeze({side}_padded)
    {side}_twice = Mul({side}_more, two)
    {side}_period = Max({side}_twice, one)
    {side}_all = Range(zero, {side}_end, step)
    {side}_there = Mod({side}_all, {side}_period)
    {side}_back = Sub({side}_period, {side}_there)
    {side}_place = Min({side}_there, {side}_back)"""
INPUTS = f"""
describe (float gray, float keypoints, float diameters) => () <
    float white = {{255}}, float smallest = {{1}}, int64 zero = {{0}}, int64 step = {{1}},
    int64[1] one = {{1}}, int64[1] two = {{2}}, int64[1] stride = {{{STRIDE}}}
> {{
    values = Div(gray, white)
{MIRRORED.format(side="height", axis=2, next=3)}
{MIRRORED.format(side="width", axis=3, next=4)}
    rows = Gather<axis = 2>(values, height_place)
    luma = Gather<axis = 3>(rows, width_place)
    xy = Identity(keypoints)
    sizes = Max(diameters, smallest)
}}"""
"""Nodes, as text of ONNX, that pad the luma, in [0, 1], as `describe_batch` does."""

REAL, IMAGINARY = CONSTANT, CONSTANT + len(FREQUENCIES)
TURNED = f"""
describe (float upright, float angles, float scores) => () <
    float to_radians = {{{-np.pi / 180}}}, float[{len(FREQUENCIES)}] factors =
    {{{", ".join(map(str, FREQUENCIES))}}}, float nothing = {{0}}, int64[1] first = {{0}},
    int64[1] real_part = {{{REAL}}}, int64[1] imaginary_part = {{{IMAGINARY}}},
    int64[1] end = {{{LENGTH}}}, int64[1] last = {{2}}
> {{
    one_angle = Unsqueeze(angles, last)
    radians = Mul(one_angle, to_radians)
    turns = Mul(radians, factors)
    c = Cos(turns)
    s = Sin(turns)
    constant = Slice(upright, first, real_part, last)
    real = Slice(upright, real_part, imaginary_part, last)
    imaginary = Slice(upright, imaginary_part, end, last)
    real_c = Mul(real, c)
    imaginary_s = Mul(imaginary, s)
    real_s = Mul(real, s)
    imaginary_c = Mul(imaginary, c)
    turned_real = Sub(real_c, imaginary_s)
    turned_imaginary = Add(real_s, imaginary_c)
    turned = Concat<axis = 2>(constant, turned_real, turned_imaginary)
    found = Greater(scores, nothing)
    each = Unsqueeze(found, last)
    result = Where(each, turned, nothing)
}}"""
"""Nodes that rotate descriptors to the keypoints' own angles, as `turn_descriptors` does."""


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
    if descriptor is not None:
        _describe(points, descriptor)
    for output in points.output:
        sides = output.type.tensor_type.shape.dim
        sides[0].CopyFrom(model.graph.input[0].type.tensor_type.shape.dim[0])
        sides[1].dim_value = max_keypoints
    model.graph.node.extend(points.node)
    model.graph.initializer.extend(points.initializer)
    model.graph.output.extend(points.output)


def _describe(points: GraphProto, descriptor: str | Path) -> None:
    """Let a graph of points also output their descriptors."""
    import onnx

    descriptor_type(descriptor)  # raises an error if the file is no descriptor
    network = onnx.load(DESCRIPTOR_GRAPHS.get(str(descriptor), Path(descriptor))).graph
    before, after = (onnx.parser.parse_graph(text) for text in (INPUTS, TURNED))
    ends = {"gray": GRAY, "diameters": "sizes", **{name: name for name in POINTS}}
    for part, names in (
        (before, ends | {"sizes": f"{DESCRIBING}sizes"}),
        (network, {"descriptors": f"{DESCRIBING}upright"}),
        (after, ends | {"result": DESCRIPTORS}),
    ):
        onnx.compose.add_prefix_graph(part, DESCRIBING, inplace=True)
        for node in part.node:
            for name, other in names.items():
                rename(node, DESCRIBING + name, other)
        points.node.extend(part.node)
        points.initializer.extend(part.initializer)
    shape = "batch", "keypoints", LENGTH
    points.output.append(onnx.helper.make_tensor_value_info(DESCRIPTORS, 1, shape))


def remove_points(model: ModelProto) -> None:
    """Remove the nodes and outputs that `add_points` has added."""
    graph, names = model.graph, (*POINTS, DESCRIPTORS)
    kept = [value for value in graph.output if value.name not in names]
    nodes = [n for n in graph.node if not n.output[0].startswith((PREFIX, DESCRIBING, *names))]
    del graph.output[:]
    graph.output.extend(kept)
    replace_nodes(graph, nodes)
