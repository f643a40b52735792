"""Parts of a network that is an ONNX file, cut out at named tensors.

The package `onnx` could do it, but is not needed to run a network. Only the outermost messages of
the format (onnx.proto3) are read: nodes and weights are copied as they are.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

MODEL_GRAPH = 7
GRAPH_NODE, GRAPH_NAME, GRAPH_INITIALIZER, GRAPH_INPUT, GRAPH_OUTPUT = 1, 2, 5, 11, 12
NODE_INPUT, NODE_OUTPUT = 1, 2
NAME = {GRAPH_INITIALIZER: 8, GRAPH_INPUT: 1, GRAPH_OUTPUT: 1}
"""Where the name is in what has one."""

FLOAT = 1

Bytes = bytes | memoryview
"""Parts of a file are views of it: copies would take several times its size."""


def cut_onnx(model: bytes, inputs: Sequence[str], outputs: Sequence[str]) -> bytes:
    """Cut out of an ONNX file what computes some tensors, (1, C, H, W) float32, from others.

    A KeyError says which tensor is not there, or needs more than the inputs.
    """
    return _cut(
        _read(model),
        {name: _message(GRAPH_INPUT, _tensor(name)) for name in inputs},
        {name: _message(GRAPH_OUTPUT, _tensor(name)) for name in outputs},
    )


def leave_out_outputs(model: bytes, names: Collection[str]) -> bytes:
    """Cut off an ONNX file what computes these outputs only; without them it stays the same.

    ONNX Runtime computes all outputs of a file, asked for or not.
    """
    graph = _read(model)
    kept = {name: raw for name, raw in graph.outputs.items() if name not in names}
    return model if len(kept) == len(graph.outputs) else _cut(graph, graph.inputs, kept)


class _Graph(NamedTuple):
    """What an ONNX file holds, each part as it is written there."""

    model: list[Bytes]  # all but the graph
    nodes: list[tuple[Bytes, list[str], list[str]]]  # with the tensors that are read and written
    weights: dict[str, Bytes]
    inputs: dict[str, Bytes]
    outputs: dict[str, Bytes]


def _cut(graph: _Graph, inputs: Mapping[str, Bytes], outputs: Mapping[str, Bytes]) -> bytes:
    """Return the content of a file that computes some tensors from others."""
    wanted, nodes, used = set(outputs), [], []
    for raw, read, written in reversed(graph.nodes):
        if wanted.isdisjoint(written):
            continue
        nodes.append(raw)
        wanted -= set(written)
        used += [name for name in read if name in graph.weights]
        wanted |= {name for name in read if name not in graph.weights and name not in inputs}
    if wanted:
        raise KeyError(min(wanted))
    weights = [graph.weights[name] for name in dict.fromkeys(used)]
    name = _message(GRAPH_NAME, b"part")
    part = [*nodes[::-1], name, *weights, *inputs.values(), *outputs.values()]
    length = _number(sum(map(len, part)))
    return b"".join([*graph.model, _number(MODEL_GRAPH << 3 | 2), length, *part])


def _read(model: bytes) -> _Graph:
    parts = _Graph([], [], {}, {}, {})
    named = {
        GRAPH_INITIALIZER: parts.weights,
        GRAPH_INPUT: parts.inputs,
        GRAPH_OUTPUT: parts.outputs,
    }
    graph: Bytes = b""
    for number, payload, raw in _fields(model):
        if number == MODEL_GRAPH:
            graph = payload
        else:
            parts.model.append(raw)
    for number, payload, raw in _fields(graph):
        if number == GRAPH_NODE:
            names = [(kind, str(name, "utf-8")) for kind, name, _ in _fields(payload) if kind <= 2]
            read = [name for kind, name in names if kind == NODE_INPUT and name]
            written = [name for kind, name in names if kind == NODE_OUTPUT]
            parts.nodes.append((raw, read, written))
        elif number in named:
            name = next(text for kind, text, _ in _fields(payload) if kind == NAME[number])
            named[number][str(name, "utf-8")] = raw
    return parts


def _fields(data: Bytes) -> Iterator[tuple[int, memoryview, memoryview]]:
    """Yield number, payload and whole text of each field of a message in protobuf's format."""
    data, place = memoryview(data), 0
    while place < len(data):
        start = place
        tag, place = _varint(data, place)
        first, kind = place, tag & 7
        if kind == 0:
            _, place = _varint(data, place)
        elif kind == 2:
            length, first = _varint(data, place)
            place = first + length
        else:
            place += {1: 8, 5: 4}[kind]
        if place > len(data):
            raise EOFError("the file ends within a message")
        yield tag >> 3, data[first:place], data[start:place]


def _varint(data: memoryview, place: int) -> tuple[int, int]:
    """Read a number; return it, and the place behind it."""
    value = shift = 0
    while True:
        byte = data[place]
        value |= (byte & 127) << shift
        place, shift = place + 1, shift + 7
        if byte < 128:
            return value, place


def _number(value: int) -> bytes:
    text = bytearray()
    while value > 127:
        text.append(value & 127 | 128)
        value >>= 7
    return bytes([*text, value])


def _message(number: int, payload: bytes) -> bytes:
    return _number(number << 3 | 2) + _number(len(payload)) + payload


def _tensor(name: str) -> bytes:
    """Describe (1, C, H, W) float32 of any size: a name, and a type of four free dimensions."""
    sides = b"".join(_message(1, _message(2, f"{name}:{k}".encode())) for k in range(4))
    kind = _number(1 << 3) + _number(FLOAT) + _message(2, sides)
    return _message(1, name.encode()) + _message(2, _message(1, kind))
