"""Write the ONNX files, each with one node, with which matchers multiply descriptors.

    python tools/product_graphs.py

Each file multiplies the matrices a (n, d) and b (d, m), and returns their product y (n, m).
"""

from __future__ import annotations

import argparse
from pathlib import Path

from onnx import ModelProto, TensorProto, helper

from deepdetect.features.matchers import PRODUCTS

OPSET, IR_VERSION = 13, 8
GRAPHS = {
    "float": ("MatMul", TensorProto.FLOAT, TensorProto.FLOAT, TensorProto.FLOAT),
    "signed": ("MatMulInteger", TensorProto.UINT8, TensorProto.INT8, TensorProto.INT32),
    "unsigned": ("MatMulInteger", TensorProto.UINT8, TensorProto.UINT8, TensorProto.INT32),
}
"""Operator and types of a, b and y for each file, keyed by its name."""


def product_graph(name: str) -> ModelProto:
    """Make the ONNX model for a name from `GRAPHS`."""
    operator, *types = GRAPHS[name]
    shapes = (("a", ["n", "d"]), ("b", ["d", "m"]), ("y", ["n", "m"]))
    a, b, y = (
        helper.make_tensor_value_info(tensor, kind, shape)
        for (tensor, shape), kind in zip(shapes, types, strict=True)
    )
    graph = helper.make_graph([helper.make_node(operator, ["a", "b"], ["y"])], "g", [a, b], [y])
    opset = helper.make_opsetid("", OPSET)
    return helper.make_model(graph, ir_version=IR_VERSION, opset_imports=[opset])


def main() -> None:
    """Write all graphs to the package or a given folder."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("output", nargs="?", type=Path, default=PRODUCTS)
    output = parser.parse_args().output
    for name in GRAPHS:
        (output / f"{name}.onnx").write_bytes(product_graph(name).SerializeToString())


if __name__ == "__main__":
    main()
