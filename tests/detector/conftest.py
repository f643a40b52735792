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


@pytest.fixture(scope="session")
def fast_network(photo: np.ndarray) -> Any:
    """A random `FastNetwork` in evaluation mode that has seen photographs: all of its parts act."""
    torch = pytest.importorskip("torch", reason="needs torch, which is for training only")
    from deepdetect_lab.networks.fast import FastNetwork

    with torch.random.fork_rng(devices=()), torch.no_grad():
        torch.manual_seed(2)
        network = FastNetwork().train()
        torch.nn.init.normal_(network.gain[2].weight, std=0.3)
        views = np.stack([photo, photo[::-1] // 2]).transpose(0, 3, 1, 2)
        for _ in range(20):
            network(torch.from_numpy(views / np.float32(255)))
        return network.eval()


@pytest.fixture(scope="session")
def fast_files(fast_network: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Weights of the fast network as ONNX and safetensors."""
    pytest.importorskip("onnx", reason="needs onnx, which is for exporting only")
    from deepdetect_lab.networks.export import export_onnx
    from deepdetect_lab.networks.weights import save_tensors

    folder = tmp_path_factory.mktemp("fast")
    files = folder / "fast.onnx", folder / "fast.safetensors"
    export_onnx(fast_network, files[0])
    save_tensors(fast_network.state_dict(), files[1], {})
    return files
