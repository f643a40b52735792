"""A network's ONNX file in half precision, or with eight-bit integers.

Only the network itself is changed: images, padding, logits and probabilities stay float32.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .onnx_graph import (
    IMAGE,
    LOGITS,
    PADDED_IMAGE,
    PADDED_LOGITS,
    rename,
    replace_nodes,
    split_nodes,
)

if TYPE_CHECKING:
    from onnx import ModelProto

QUANTIZED = "/network/encoder/level3"
"""Beginning of the names of the convolutions that int8 changes: those at an eighth of the size.

Three quarters of all weights are there. Before and behind them rounding to 255 steps costs more
marks than it saves time (docs/other-programs.md#onnx).
"""


def to_float16(model: ModelProto) -> None:
    """Turn the weights of a network with padding into float16, and compute with them; in place."""
    from onnx import TensorProto, helper, numpy_helper

    graph = model.graph
    before, inner, behind = split_nodes(graph)
    weights = {name for node in inner for name in node.input}
    for one in graph.initializer:
        if one.name in weights:
            halved = numpy_helper.to_array(one).astype(np.float16)
            one.CopyFrom(numpy_helper.from_array(halved, one.name))
    image, logits = (PADDED_IMAGE, PADDED_LOGITS) if before else (IMAGE, LOGITS)
    for node in inner:
        rename(node, image, f"{image}_float16")
        rename(node, logits, f"{logits}_float16")
    down = helper.make_node("Cast", [image], [f"{image}_float16"], to=TensorProto.FLOAT16)
    up = helper.make_node("Cast", [f"{logits}_float16"], [logits], to=TensorProto.FLOAT)
    replace_nodes(graph, [*before, down, *inner, up, *behind])


def to_int8(model: ModelProto, images: Iterable[np.ndarray]) -> ModelProto:
    """Quantise the convolutions named `QUANTIZED`: weights per channel, activations per tensor.

    Args:
        model: what `add_padding` made.
        images: (H, W, 3) uint8 RGB that the ranges of the activations are taken from.

    Returns:
        A model in the QDQ format of ONNX, which any runtime that knows it can run.
    """
    import onnx
    from onnxruntime.quantization import (
        CalibrationDataReader,
        QuantFormat,
        QuantType,
        quantize_static,
    )

    class Reader(CalibrationDataReader):  # type: ignore[misc]
        def __init__(self) -> None:
            self._images = iter(images)

        def get_next(self) -> dict[str, np.ndarray] | None:
            rgb = next(self._images, None)
            if rgb is None:
                return None
            planes = rgb.transpose(2, 0, 1)[None].astype(np.float32) / np.float32(255)
            return {IMAGE: np.ascontiguousarray(planes)}

    others = [
        node.name
        for node in model.graph.node
        if node.op_type == "Conv" and not node.name.startswith(QUANTIZED)
    ]
    with tempfile.TemporaryDirectory() as folder, _quiet():
        whole, made = Path(folder) / "whole.onnx", Path(folder) / "int8.onnx"
        onnx.save_model(model, str(whole))
        quantize_static(
            whole,
            made,
            Reader(),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=["Conv"],
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            nodes_to_exclude=others,
        )
        return onnx.load_model(str(made))


@contextmanager
def _quiet() -> Iterator[None]:
    """Hide the advice that the quantiser logs."""
    logger = logging.getLogger()
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)
