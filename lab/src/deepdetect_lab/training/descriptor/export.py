"""The ONNX file of the learned descriptor."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import onnx
import torch
from torch import nn
from torch.nn.utils.fusion import fuse_linear_bn_eval

from deepdetect._shared.atomic import atomic_path
from deepdetect.detector.points.descriptor import STRIDE

from ...networks.export import halve_weights, to_onnx
from .network import DescriptorNetwork


def export_descriptor(network: DescriptorNetwork, path: Path) -> None:
    """Write a network as an ONNX file for `PointDetector(descriptor=...)`.

    `DESCRIPTOR_GRAPHS` lists the inputs and outputs.
    """
    network = copy.deepcopy(network).eval()
    for linear, norm in (("input", "norm"), ("middle", "middle_norm")):
        layers: Any = [network.get_submodule(name) for name in (linear, norm)]
        setattr(network, linear, fuse_linear_bn_eval(*layers))
        setattr(network, norm, nn.Identity())
    luma = torch.zeros(2, 1, STRIDE, 2 * STRIDE)
    inputs = {"luma": luma, "xy": torch.ones(2, 50, 2), "sizes": torch.ones(2, 50)}
    axes = {name: {0: "batch", 1: "keypoints"} for name in ("xy", "sizes", "descriptors")}
    axes["luma"] = {0: "batch", 2: "height", 3: "width"}
    model = to_onnx(network, inputs, ("descriptors",), axes)
    halve_weights(model)
    with atomic_path(path) as temporary:
        onnx.save(model, temporary)
