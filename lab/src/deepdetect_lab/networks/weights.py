"""Find networks by name, and read and write their weights and notes as safetensors files."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from deepdetect._shared.atomic import atomic_path
from deepdetect._shared.errors import MissingWeightsError, WeightsError
from deepdetect._shared.options import look_up, names_a_file
from deepdetect.detector.pretrained import PRETRAINED

from .espnet import ESPNet
from .fast import FastNetwork

NETWORKS: dict[str, type[nn.Module]] = {"espnet": ESPNet, "fast": FastNetwork}
"""Classes of networks by name. A network is made without arguments, and maps (B, 3, H, W) float32
RGB in [0, 1] to (B, 1, H, W) logits.

H and W are multiples of `STRIDE`. To add a network, write a module in this package and add it here.
"""


FOLDER = Path(__file__).parents[1] / "weights"
"""Folder of trained weights to start from; `deepdetect` has the same weights as ONNX files."""


def find_weights(weights: str | Path) -> Path:
    """Return the path of a weights file, from its path or from a name in `PRETRAINED`."""
    if names_a_file(weights):
        return Path(weights)
    return FOLDER / f"{look_up('name or file of weights', str(weights), PRETRAINED)}.safetensors"


def save_tensors(tensors: Mapping[str, Tensor], path: str | Path, notes: dict[str, str]) -> None:
    """Write tensors to a safetensors file, atomically, with `notes` in its header."""
    stored = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    with atomic_path(path) as temporary:
        try:
            save_file(stored, temporary, metadata=notes)
        except SafetensorError as error:  # for example a full disk
            raise OSError(str(error)) from None


def load_network(path: str | Path, *kinds: type[nn.Module]) -> nn.Module:
    """Load a network from a weights file, in evaluation mode.

    The class of the network is the one of `kinds` (default: all of `NETWORKS`) that has most tensor
    names in common with the file.
    """
    if not Path(path).is_file():
        raise MissingWeightsError(f"there is no weights file {path}: check the path")
    networks = [make() for make in kinds or NETWORKS.values()]
    try:
        with safe_open(path, framework="pt") as file:
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        network = max(networks, key=lambda each: len(each.state_dict().keys() & state.keys()))
        network.load_state_dict(state)
    except (SafetensorError, OSError, RuntimeError) as error:
        # The second line of torch's message names the first wrong tensor.
        reason = " ".join(str(error).split("\n\t")[:2]).strip()
        reason = reason if len(reason) < 160 else reason[:160] + "..."
        raise WeightsError(
            f"{path} does not fit the network ({reason}): "
            "use weights that deepdetect has trained, or the published ones"
        ) from None
    return network.eval()


def average_weights(paths: Sequence[str | Path]) -> nn.Module:
    """Load a network, as `load_network` does, with the mean of the weights in several files.

    The mean of the weights of several training runs is often better than the weights of any run
    (Wortsman et al., "Model soups", 2022). Integers, the counters of batch normalisation, are taken
    from the first file.
    """
    networks = [load_network(path) for path in paths]
    for path, network in zip(paths, networks, strict=True):
        if type(network) is not type(networks[0]):
            raise WeightsError(
                f"{path} is for another network than {paths[0]}: give files for one network"
            )
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
    """Return the SHA-256 of a network's state dict. It does not depend on any file format."""
    digest = hashlib.sha256()
    for name, value in sorted(network.state_dict().items()):
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
