"""ONNX files that are no network of the package."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

FREE_IMAGE, FREE_MAP = ("n", 3, "h", "w"), ("n", 1, "h", "w")


@pytest.fixture
def onnx_file(tmp_path: Path) -> Callable[..., Path]:
    """Make an ONNX file of the mean over the channels, and of what some nodes make of it."""
    onnx = pytest.importorskip("onnx")

    def make(
        *nodes: tuple[str, str],
        given: Sequence[int | str] = FREE_IMAGE,
        result: Sequence[int | str] = FREE_MAP,
        kind: str = "FLOAT",
        output: str = "probability",
        **attributes: Any,
    ) -> Path:
        """Add nodes, each of a type and what it takes beside the result of the one before."""
        helper, element = onnx.helper, getattr(onnx.TensorProto, kind)
        constants = {
            "minus": np.float32(-1),
            "five": np.float32(5),
            "repeats": np.array([1, 1, 1, 2], np.int64),
        }
        chain = [helper.make_node("ReduceMean", ["image"], ["mean"], axes=[1], keepdims=1)]
        for k, (name, other) in enumerate(nodes):
            inputs = [chain[-1].output[0], *([other] if other else [])]
            given_here = attributes if not other else {}
            chain.append(helper.make_node(name, inputs, [f"step{k}"], **given_here))
        chain.append(helper.make_node("Identity", [chain[-1].output[0]], [output]))
        graph = helper.make_graph(
            chain,
            "graph",
            [helper.make_tensor_value_info("image", element, given)],
            [helper.make_tensor_value_info(output, element, result)],
            [onnx.numpy_helper.from_array(value, name) for name, value in constants.items()],
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
        onnx.save(model, str(tmp_path / "made.onnx"))
        return tmp_path / "made.onnx"

    return make
