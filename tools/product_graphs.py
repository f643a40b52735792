"""Write the ONNX files with which matchers multiply descriptors.

    python tools/product_graphs.py

The files of `GRAPHS`, each with one node, multiply the matrices a (n, d) and b (d, m), and return
their product y (n, m). `nearest.onnx` also returns the two largest values of each row of y with
their columns, and the row of the largest value of each column.
"""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path

from onnx import ModelProto, TensorProto, helper, parser

from deepdetect.features.matchers import PRODUCTS

OPSET, IR_VERSION = 13, 8
GRAPHS = {
    "float": ("MatMul", TensorProto.FLOAT, TensorProto.FLOAT, TensorProto.FLOAT),
    "signed": ("MatMulInteger", TensorProto.UINT8, TensorProto.INT8, TensorProto.INT32),
    "unsigned": ("MatMulInteger", TensorProto.UINT8, TensorProto.UINT8, TensorProto.INT32),
}
"""Operator and types of a, b and y for each file, keyed by its name."""

NEAREST = f"""<ir_version: {IR_VERSION}, opset_import: ["" : {OPSET}]>
nearest (float[n, d] a, float[d, m] b)
    => (float[n, 2] similarities, int64[n, 2] columns, int64[m] rows) <int64[1] two = {{2}}> {{
    y = MatMul(a, b)
    similarities, columns = TopK(y, two)
    rows = ArgMax<axis = 0, keepdims = 0>(y)
}}"""


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
    arguments = ArgumentParser(description=(__doc__ or "").splitlines()[0])
    arguments.add_argument("output", nargs="?", type=Path, default=PRODUCTS)
    output = arguments.parse_args().output
    for name in GRAPHS:
        (output / f"{name}.onnx").write_bytes(product_graph(name).SerializeToString())
    nearest = parser.parse_model(NEAREST)
    (output / "nearest.onnx").write_bytes(nearest.SerializeToString())


if __name__ == "__main__":
    main()
