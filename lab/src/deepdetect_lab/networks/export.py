"""Export networks from torch to ONNX files for any image size, which `deepdetect` reads."""

from __future__ import annotations

import io
import logging
import warnings
from collections import OrderedDict
from pathlib import Path
from typing import TYPE_CHECKING

from deepdetect.detector.network.onnx_export import OnnxOptions, write_model
from deepdetect.detector.network.onnx_graph import add_padding

if TYPE_CHECKING:
    from onnx import ModelProto
    from torch import nn

OPSET = 17
"""This ONNX operator set is chosen because ONNX Runtime 1.24, OpenVINO and OpenCV 4 read it."""


def export_onnx(network: nn.Module, path: str | Path) -> None:
    """Write a network for any image size, atomically."""
    write_model(_of_torch(network), path, OnnxOptions(max_keypoints=0), {})


def _of_torch(network: nn.Module) -> ModelProto:
    import onnx
    import torch

    # This name is part of all node names, on which `tiling` relies.
    module = torch.nn.Sequential(OrderedDict(network=network.cpu())).eval()
    axes = {0: "batch", 2: "height", 3: "width"}
    written = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        torch.onnx.export(
            module,
            (torch.zeros(2, 3, 64, 96),),
            written,  # type: ignore[arg-type]  # annotated for the other exporter
            input_names=["image"],
            output_names=["logits"],
            dynamic_axes={"image": axes, "logits": axes},
            opset_version=OPSET,
            dynamo=False,
            # Keeps batch normalisation as nodes, which `add_padding` folds in float64. The network
            # is already in evaluation mode.
            training=torch.onnx.TrainingMode.PRESERVE,
        )
    model = onnx.load_model_from_string(written.getvalue())
    add_padding(model)
    return model
