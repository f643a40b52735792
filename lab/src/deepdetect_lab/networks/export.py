"""Networks of torch as ONNX files, as `deepdetect` reads them."""

from __future__ import annotations

import io
import logging
import warnings
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import onnx
import torch
from torch import Tensor, nn

from deepdetect.detector.network.onnx_export import OnnxOptions, write_model
from deepdetect.detector.network.onnx_graph import add_padding

OPSET = 17
"""The ONNX operator set of all files: ONNX Runtime 1.24, OpenVINO and OpenCV 4 read it."""


def to_onnx(
    network: nn.Module,
    inputs: Mapping[str, Tensor],
    output: str,
    axes: Mapping[str, Mapping[int, str]],
    training: Any = torch.onnx.TrainingMode.EVAL,
) -> onnx.ModelProto:
    """Trace a network with inputs by name; `axes` are those of any length, by name and number."""
    written = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what it traces
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        torch.onnx.export(
            network.cpu().eval(),
            tuple(inputs.values()),
            written,  # type: ignore[arg-type]  # its annotation is of the other exporter
            input_names=list(inputs),
            output_names=[output],
            dynamic_axes=axes,
            opset_version=OPSET,
            dynamo=False,
            training=training,
        )
    return onnx.load_model_from_string(written.getvalue())


def export_onnx(network: nn.Module, path: str | Path) -> None:
    """Write a network that makes heat maps, for any size; whole or not at all."""
    # Its parts are named after it: `tiling` knows the names that PyTorch's exporter gives.
    module = nn.Sequential(OrderedDict(network=network))
    axes = {0: "batch", 2: "height", 3: "width"}
    # Batch normalisation stays as nodes, for `add_padding` to fold in float64.
    model = to_onnx(
        module,
        {"image": torch.zeros(2, 3, 64, 96)},
        "logits",
        {"image": axes, "logits": axes},
        torch.onnx.TrainingMode.PRESERVE,
    )
    add_padding(model)
    write_model(model, path, OnnxOptions(max_keypoints=0), {})
