"""Cutting out the part of a network in an ONNX file that lies between named tensors.

The code needs Protobuf, but not the package `onnx`. Protobuf copies undeclared fields unchanged.
"""

from __future__ import annotations

import functools
from collections.abc import Collection
from typing import Any

FIELDS: dict[str, dict[str, tuple[int, str]]] = {
    "Model": {"graph": (7, "Graph")},
    "Graph": {
        "node": (1, "Node"),
        "initializer": (5, "Weights"),
        "input": (11, "Tensor"),
        "output": (12, "Tensor"),
    },
    "Node": {"input": (1, "string"), "output": (2, "string"), "attribute": (5, "Attribute")},
    "Attribute": {"graph": (6, "Graph")},
    "Weights": {"side": (1, "int64"), "element": (2, "int32"), "name": (8, "string")},
    "Tensor": {"name": (1, "string"), "type": (2, "Type")},
    "Type": {"array": (1, "Array")},
    "Array": {"element": (1, "int32"), "shape": (2, "Shape")},
    "Shape": {"side": (1, "Side")},
    "Side": {"length": (1, "int64")},
}
"""Numbers and types of the fields in onnx.proto3, by message. All fields are declared as repeated,
because Protobuf writes a single value in the same way."""

FLOAT = 1


def cut_onnx(model: bytes, inputs: Collection[str], outputs: Collection[str]) -> bytes:
    """Return the part of an ONNX file that computes float32 `outputs` from `inputs`.

    Inputs are float32 maps of four axes, or constants of any type and shape, whose values are then
    given in each run. A KeyError names a tensor that is missing or cannot be computed from them.
    """
    part = _model_class()()
    part.ParseFromString(model)
    graph = part.graph[0]
    given = {*inputs, *(one.name[0] for one in graph.initializer)}
    wanted, used, nodes = set(outputs), set[str](), []
    for node in reversed(graph.node):
        if not wanted.isdisjoint(node.output):
            nodes.append(node)
            used |= _read_by(node)
            wanted = (wanted | _read_by(node)) - {*node.output, *given, ""}
    if wanted:
        raise KeyError(min(wanted))
    constants = {one.name[0]: (one.element[0], one.side) for one in graph.initializer}
    weights = [one for one in graph.initializer if one.name[0] in used - {*inputs}]
    del graph.node[:], graph.initializer[:], graph.input[:], graph.output[:]
    graph.node.extend(nodes[::-1])
    graph.initializer.extend(weights)
    for name in inputs:
        element, sides = constants.get(name, (FLOAT, [None] * 4))
        array = graph.input.add(name=[name]).type.add().array.add(element=[element])
        shape = array.shape.add()
        for side in sides:
            shape.side.add(length=[] if side is None else [side])
    for name in outputs:
        graph.output.add(name=[name])
    return part.SerializeToString()


def _read_by(node: Any) -> set[str]:
    """Return the names of the tensors that a node reads, also inside of its loops."""
    names = {*node.input}
    for loop in (graph for attribute in node.attribute for graph in attribute.graph):
        own = {one.name[0] for one in (*loop.input, *loop.initializer)}
        for inner in loop.node:
            names |= _read_by(inner) - own
            own.update(inner.output)
    return names


@functools.cache
def _model_class() -> Any:
    """Declare `FIELDS` to Protobuf; return the class that reads a whole ONNX file."""
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message_factory import GetMessageClass

    file = FileDescriptorProto(name="onnx_parts.proto", package="parts")
    for message, fields in FIELDS.items():
        declared = file.message_type.add(name=message)
        for name, (number, kind) in fields.items():
            field = declared.field.add(name=name, number=number)
            field.label = FieldDescriptorProto.LABEL_REPEATED
            if kind in FIELDS:
                field.type, field.type_name = FieldDescriptorProto.TYPE_MESSAGE, f".parts.{kind}"
            else:
                field.type = FieldDescriptorProto.Type.Value(f"TYPE_{kind.upper()}")
    pool = DescriptorPool()
    pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName("parts.Model"))
