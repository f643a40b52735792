"""Weights, ONNX files and checkpoints."""

from __future__ import annotations

import io
import json
import struct
import tempfile
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np

from deepdetect import DeepDetect
from deepdetect.detector.pretrained import pretrained_weights

from ..case import Target, expect, prepared
from ..mutations import mutate
from .images import scene


def onnx(generator: np.random.Generator, folder: Path) -> None:
    """Run a damaged ONNX file."""
    path = folder / "weights.onnx"
    path.write_bytes(mutate(pretrained_weights().read_bytes(), generator))
    check_map(DeepDetect(path, backend="onnxruntime").heatmap(scene()))


def check_map(found: np.ndarray) -> None:
    """Check that a map can be one of probabilities."""
    expect(found.shape == scene().shape[:2], f"a map of shape {found.shape}")
    expect(np.isfinite(found).all(), "a map that is not finite")
    expect(found.min() >= 0 and found.max() <= 1, "a map that is no probability")


@prepared
def safetensors_file() -> bytes:
    """Return weights of the network as a safetensors file."""
    from safetensors.torch import save

    from deepdetect_lab.networks.espnet import ESPNet

    return bytes(save(ESPNet().state_dict()))


def safetensors(generator: np.random.Generator, folder: Path) -> None:
    """Run damaged weights: of bytes, or with wrong tensors."""
    from safetensors.numpy import load, save

    content = safetensors_file()
    if generator.random() < 0.6:
        content = mutate(content, generator)
    else:
        tensors = dict(load(content))
        name = str(generator.choice(list(tensors)))
        value = tensors[name]
        choice = generator.integers(5)
        if choice == 0:
            del tensors[name]
        elif choice == 1:
            tensors[name] = np.full_like(value, np.nan if value.dtype.kind == "f" else -1)
        elif choice == 2:
            tensors[name] = np.zeros((3, *value.shape), value.dtype)
        elif choice == 3:
            tensors[name] = value.astype(np.float16)
        else:
            tensors["further"] = value
        content = save(tensors)
    path = folder / "weights.safetensors"
    path.write_bytes(content)
    check_map(DeepDetect(path, backend="torch").heatmap(scene()))


@prepared
def checkpoint_content() -> bytes:
    """Return a checkpoint of a small network after a step."""
    import torch

    from deepdetect_lab.training.checkpoint import save_checkpoint

    network, optimizers = small_training()
    network(torch.ones(2, 3)).sum().backward()
    for optimizer in optimizers:
        optimizer.step()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "checkpoint.safetensors"
        save_checkpoint(path, network, deepcopy(network), optimizers, {"step": 3, "points": []})
        return path.read_bytes()


def small_training() -> tuple[Any, list[Any]]:
    """Return a small network and its optimisers, as a training has them."""
    import torch

    from deepdetect_lab.training.optim import make_optimizers

    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.PReLU(4), torch.nn.Linear(4, 1))
    return network, list(make_optimizers("soap", network))


def checkpoints(generator: np.random.Generator, folder: Path) -> None:
    """Resume from a checkpoint whose bytes or tensors are wrong, and take a step."""
    import torch
    from safetensors.numpy import load, save

    from deepdetect_lab.training.checkpoint import read_checkpoint, restore

    content = checkpoint_content()
    if generator.random() < 0.5:
        content = mutate(content, generator)
    else:  # as it is but for one tensor, with its header
        length = struct.unpack("<Q", content[:8])[0]
        header = json.loads(content[8 : 8 + length])["__metadata__"]
        tensors = dict(load(content))
        name = str(generator.choice(list(tensors)))
        strange = [
            np.zeros(3, np.float32),
            tensors[name].astype(np.float64),
            np.full_like(tensors[name], np.nan),
            np.zeros((2, *tensors[name].shape), np.float32),
        ]
        tensors[name] = strange[int(generator.integers(len(strange)))]
        content = save(tensors, header)
    path = folder / "checkpoint.safetensors"
    path.write_bytes(content)
    network, optimizers = small_training()
    tensors, metadata = read_checkpoint(path)
    restore(tensors, network, deepcopy(network), optimizers)
    network(torch.ones(2, 3)).sum().backward()
    for optimizer in optimizers:
        optimizer.step()
    expect(metadata["step"] == 3, f"step {metadata['step']}")
    expect(all(p.isfinite().all() for p in network.parameters()), "weights that are not finite")


def header(generator: np.random.Generator, folder: Path) -> None:
    """Read weights whose header lies about what follows."""
    lies = [
        struct.pack("<Q", 2**63) + b"{}",
        struct.pack("<Q", 10) + b"{" * 10,
        struct.pack("<Q", 100_000) + b"[" * 100_000,
        struct.pack("<Q", 2) + b"{}",
        struct.pack("<Q", 0),
        b"",
        b"\x80\x04.",
    ]
    file = io.BytesIO()
    file.write(lies[int(generator.integers(len(lies)))])
    file.write(generator.bytes(int(generator.integers(0, 50))))
    path = folder / "weights.safetensors"
    path.write_bytes(file.getvalue())
    DeepDetect(path, backend="torch")
    expect(False, "no weights were taken for some")


TARGETS = (
    Target("onnx", "damaged ONNX files", onnx, 500, 100),
    Target("safetensors", "damaged and altered weights", safetensors, 500, 250),
    Target("headers", "weights with wrong headers", header, 100, 100),
    Target("checkpoints", "damaged and altered checkpoints", checkpoints, 700, 350),
)
