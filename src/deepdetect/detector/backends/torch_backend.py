"""torch: runs safetensors weights where it is installed (it is needed for training only)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .shapes import LOGITS, as_logits

if TYPE_CHECKING:
    from .registry import RuntimeOptions


class TorchNetwork:
    """A network run by torch on the CPU."""

    def __init__(self, network: object, path: Path) -> None:
        self._network = network
        self._path = path

    def __call__(self, image: np.ndarray) -> np.ndarray:
        import torch

        with torch.inference_mode():
            tensor = torch.from_numpy(np.ascontiguousarray(image))
            tensor = tensor.contiguous(memory_format=torch.channels_last)
            logits = self._network(tensor).contiguous().numpy()
        return as_logits(logits, LOGITS, image.shape, self._path)


def open_torch(path: Path, options: RuntimeOptions) -> TorchNetwork:
    """Load a safetensors file.

    Raises:
        WeightsError: the file is damaged or does not fit the network.
    """
    import torch

    from ..network.weights import load_network

    if options.threads is not None:
        torch.set_num_threads(options.threads)
    return TorchNetwork(load_network(path).to(memory_format=torch.channels_last), path)
