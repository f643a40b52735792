"""Parts of a network that is an ONNX file, cut out at named tensors.

The package `onnx` could do it, but is not needed to run a network. Only the outermost messages of
the format (onnx.proto3) are read: nodes and weights are copied as they are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

MODEL_GRAPH = 7
GRAPH_NODE, GRAPH_NAME, GRAPH_INITIALIZER, GRAPH_INPUT, GRAPH_OUTPUT = 1, 2, 5, 11, 12
NODE_INPUT, NODE_OUTPUT = 1, 2
INITIALIZER_NAME = 8
FLOAT = 1


def cut_onnx(model: bytes, inputs: Sequence[str], outputs: Sequence[str]) -> bytes:
    """Cut out of an ONNX file what computes some tensors from others.

    Args:
        model: the file's content.
        inputs: names of the tensors to be given, (1, C, H, W) float32 of any size.
        outputs: names of the tensors to be computed, of the same kind.

    Returns:
        The content of a smaller file.

    Raises:
        KeyError: a tensor is not there, or needs more than the inputs.
    """
    rest, graph = [], b""
    for number, payload, raw in _fields(model):
        if number == MODEL_GRAPH:
            graph = payload
        else:
            rest.append(raw)
    nodes, weights = [], {}
    for number, payload, raw in _fields(graph):
        if number == GRAPH_NODE:
            names = [(kind, name.decode()) for kind, name, _ in _fields(payload) if kind <= 2]
            read = [name for kind, name in names if kind == NODE_INPUT and name]
            written = [name for kind, name in names if kind == NODE_OUTPUT]
            nodes.append((raw, read, written))
        elif number == GRAPH_INITIALIZER:
            name = next(text for kind, text, _ in _fields(payload) if kind == INITIALIZER_NAME)
            weights[name.decode()] = raw
    kept: list[bytes] = []
    wanted = set(outputs)
    used = []
    for raw, read, written in reversed(nodes):
        if wanted.isdisjoint(written):
            continue
        kept.append(raw)
        wanted -= set(written)
        used += [name for name in read if name in weights]
        wanted |= {name for name in read if name not in weights and name not in inputs}
    if wanted:
        raise KeyError(min(wanted))
    part = b"".join(
        [
            *reversed(kept),
            _message(GRAPH_NAME, b"part"),
            *(weights[name] for name in dict.fromkeys(used)),
            *(_message(GRAPH_INPUT, _tensor(name)) for name in inputs),
            *(_message(GRAPH_OUTPUT, _tensor(name)) for name in outputs),
        ]
    )
    return b"".join([*rest, _message(MODEL_GRAPH, part)])


def _fields(data: bytes) -> Iterator[tuple[int, bytes, bytes]]:
    """Yield number, payload and whole text of each field of a message in protobuf's format."""
    place = 0
    while place < len(data):
        start = place
        tag, place = _varint(data, place)
        first, kind = place, tag & 7
        if kind == 0:
            _, place = _varint(data, place)
        elif kind == 2:
            length, first = _varint(data, place)
            place = first + length
        elif kind in (1, 5):
            place += 8 if kind == 1 else 4
        else:
            raise KeyError(f"field of kind {kind}")
        yield tag >> 3, data[first:place], data[start:place]


def _varint(data: bytes, place: int) -> tuple[int, int]:
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
