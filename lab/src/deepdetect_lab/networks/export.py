"""Export networks from torch to ONNX files, which `deepdetect` reads."""

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
"""Version of the ONNX operator set, which ONNX Runtime 1.24, OpenVINO and OpenCV 4 can read."""


def to_onnx(
    network: nn.Module,
    inputs: Mapping[str, Tensor],
    output: str,
    axes: Mapping[str, Mapping[int, str]],
    training: Any = torch.onnx.TrainingMode.EVAL,
) -> onnx.ModelProto:
    """Trace a network with named inputs to ONNX. `axes` names dynamic axes of inputs and output."""
    written = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings of the tracer
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        torch.onnx.export(
            network.cpu().eval(),
            tuple(inputs.values()),
            written,  # type: ignore[arg-type]  # annotated for the other exporter
            input_names=list(inputs),
            output_names=[output],
            dynamic_axes=axes,
            opset_version=OPSET,
            dynamo=False,
            training=training,
        )
    return onnx.load_model_from_string(written.getvalue())


def export_onnx(network: nn.Module, path: str | Path) -> None:
    """Write a network that predicts heat maps for any image size, atomically."""
    # The name "network" becomes part of all node names, on which `tiling` relies.
    module = nn.Sequential(OrderedDict(network=network))
    axes = {0: "batch", 2: "height", 3: "width"}
    # Batch normalisations stay separate nodes, because `add_padding` folds them in float64.
    model = to_onnx(
        module,
        {"image": torch.zeros(2, 3, 64, 96)},
        "logits",
        {"image": axes, "logits": axes},
        torch.onnx.TrainingMode.PRESERVE,
    )
    add_padding(model)
    write_model(model, path, OnnxOptions(max_keypoints=0), {})
