"""Weights as safetensors files: a plain state dict, with notes in the header."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from ..._shared.atomic import atomic_path
from ..._shared.errors import MissingWeightsError, WeightsError
from .espnet import ESPNet


def save_tensors(tensors: Mapping[str, Tensor], path: str | Path, notes: dict[str, str]) -> None:
    """Write tensors, with notes in the file's header, whole or not at all."""
    stored = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    with atomic_path(path) as temporary:
        try:
            save_file(stored, temporary, metadata=notes)
        except SafetensorError as error:  # a full disk
            raise OSError(str(error)) from None


def load_network(path: str | Path, make: Callable[[], nn.Module] = ESPNet) -> nn.Module:
    """Make a network from a weights file, in evaluation mode."""
    if not Path(path).is_file():
        raise MissingWeightsError(f"there is no weights file {path}: check the path")
    network = make()
    try:
        with safe_open(path, framework="pt") as file:
            network.load_state_dict({name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118
    except (SafetensorError, OSError, RuntimeError) as error:
        # torch names the first wrong tensor on its second line.
        reason = " ".join(str(error).split("\n\t")[:2]).strip()
        reason = reason if len(reason) < 160 else reason[:160] + "..."
        raise WeightsError(
            f"{path} does not fit the network ({reason}): "
            "use weights that deepdetect has trained, or the published ones"
        ) from None
    return network.eval()


def average_weights(
    paths: Sequence[str | Path], make: Callable[[], nn.Module] = ESPNet
) -> nn.Module:
    """Make a network, as `load_network` does, from the mean of several weights files.

    The mean of runs that went on from one another is often better than each of them
    (Wortsman et al., "Model soups", 2022). Counts, which have no mean, are the first file's.
    """
    networks = [load_network(path, make) for path in paths]
    states = [network.state_dict() for network in networks]
    mean = {
        name: sum(state[name] for state in states) / len(states)
        if value.is_floating_point()
        else value
        for name, value in states[0].items()
    }
    networks[0].load_state_dict(mean)
    return networks[0]


def read_notes(path: str | Path) -> dict[str, str]:
    """Read the notes in a weights file's header."""
    try:
        with safe_open(path, framework="pt") as file:
            return dict(file.metadata() or {})
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{path} is not a weights file ({error})") from None


def weights_digest(network: nn.Module) -> str:
    """Return the SHA-256 of a network's state, the same whatever file it came from."""
    digest = hashlib.sha256()
    for name, value in sorted(network.state_dict().items()):
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
