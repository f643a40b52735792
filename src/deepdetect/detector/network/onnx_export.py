"""From torch to an ONNX file for any image size: `image` in; maps and the best keypoints out."""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from ..._shared.atomic import atomic_path
from .onnx_graph import ANY_SIZE, add_padding, write_metadata
from .onnx_keypoints import MAX_KEYPOINTS, add_keypoints

OPSET = 17


class ProbabilityAndLogits(nn.Module):
    """The network followed by the sigmoid, and its logits, which distinguish the best pixels."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        logits = self.network(image)
        return torch.sigmoid(logits), logits


def export_onnx(
    network: nn.Module, path: str | Path, metadata: Mapping[str, str] | None = None
) -> None:
    """Write a network as ONNX, whole or not at all.

    Args:
        network: maps (B, 3, H, W) RGB in [0, 1] to (B, 1, H, W) logits; H and W
            are multiples of 8.
        path: file ending in .onnx. Its input is `image` (batch, 3, height, width)
            float32 of any size, its outputs `probability` and `logits`, both
            (batch, 1, height, width) float32, and those of `add_keypoints`.
        metadata: what the file says beside what all say (`onnx_graph.METADATA`), as its licence.
    """
    import onnx

    module = ProbabilityAndLogits(network.cpu()).eval()
    example = torch.zeros(2, 3, 64, 96)
    axes = {0: "batch", 2: "height", 3: "width"}
    written = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        torch.onnx.export(
            module,
            (example,),
            written,  # type: ignore[arg-type]  # its annotation is of the other exporter
            input_names=["image"],
            output_names=["probability", "logits"],
            dynamic_axes={"image": axes, "probability": axes, "logits": axes},
            opset_version=OPSET,
            dynamo=False,
            # Keeps batch normalisation as nodes, for `add_padding` to fold in float64. The network
            # is in evaluation mode already.
            training=torch.onnx.TrainingMode.PRESERVE,
        )
    model = onnx.load_model_from_string(written.getvalue())
    add_padding(model)
    add_keypoints(model, MAX_KEYPOINTS)
    of_keypoints = {"max_keypoints": str(MAX_KEYPOINTS)}
    write_metadata(model, {**ANY_SIZE, **of_keypoints, **(metadata or {})})
    with atomic_path(path) as temporary:
        temporary.write_bytes(model.SerializeToString())
