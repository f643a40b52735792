"""The ONNX file of the learned descriptor."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper
from torch import nn
from torch.nn.utils.fusion import fuse_linear_bn_eval

from deepdetect._shared.atomic import atomic_path
from deepdetect.detector.points.descriptor import STRIDE

from ...networks.export import to_onnx
from .network import DescriptorNetwork

MIN_HALVED = 1000
"""Tensors with more values than this are stored as float16, which halves files of descriptors and
matchers. Chosen by hand."""


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


def halve_weights(model: onnx.ModelProto) -> None:
    """Store the large tensors of a graph as float16; the graph converts them to float32 first."""
    graph = model.graph
    for kernel in [each for each in graph.initializer if math.prod(each.dims) > MIN_HALVED]:
        values = numpy_helper.to_array(kernel).astype(np.float16)
        halved = numpy_helper.from_array(values, f"{kernel.name}_float16")
        cast = helper.make_node("Cast", [halved.name], [kernel.name], to=onnx.TensorProto.FLOAT)
        graph.node.insert(0, cast)
        graph.initializer.remove(kernel)
        graph.initializer.append(halved)
