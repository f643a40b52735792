"""torch: runs safetensors weights where it is installed (it is needed for training only)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..pretrained import LOGITS
from .interface import RuntimeOptions, as_logits, failed_run


class TorchNetwork:
    """A network run by torch on the CPU."""

    def __init__(self, network: Any, path: Path, threads: int | None) -> None:
        self._network = network
        self._path = path
        self._threads = threads

    def __call__(self, image: np.ndarray) -> np.ndarray:
        import torch

        if self._threads is not None and torch.get_num_threads() != self._threads:
            torch.set_num_threads(int(self._threads))  # of the process: another detector may set it
        try:
            with torch.inference_mode():
                tensor = torch.from_numpy(np.ascontiguousarray(image))
                tensor = tensor.contiguous(memory_format=torch.channels_last)
                logits = self._network(tensor).contiguous().numpy()
        except RuntimeError as error:
            raise failed_run(error, image.shape) from None
        return as_logits(logits, LOGITS, image.shape, self._path)


def open_torch(path: Path, options: RuntimeOptions) -> TorchNetwork:
    """Load a safetensors file."""
    import torch

    from ..network.weights import load_network

    network = load_network(path)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return TorchNetwork(network, path, options.threads)
