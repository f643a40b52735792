"""Optimisers by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from .._shared.registry import look_up

if TYPE_CHECKING:
    from torch import Tensor, nn
    from torch.optim import Optimizer

    Share = Callable[[Tensor], object]


def adam(network: nn.Module, share: Share) -> list[Optimizer]:
    """Adam for everything."""
    import torch

    return [torch.optim.Adam(_trained(network), fused=True)]


def soap(network: nn.Module, share: Share) -> list[Optimizer]:
    """SOAP for the kernels, Adam for biases and the like."""
    import torch

    from .soap import Soap

    kernels = [parameter for parameter in _trained(network) if parameter.ndim > 1]
    vectors = [parameter for parameter in _trained(network) if parameter.ndim <= 1]
    return [Soap(kernels, share=share), torch.optim.Adam(vectors, fused=True)]


def _trained(network: nn.Module) -> list[nn.Parameter]:
    return [parameter for parameter in network.parameters() if parameter.requires_grad]


OPTIMIZERS: dict[str, Callable[[nn.Module, Share], list[Optimizer]]] = {"adam": adam, "soap": soap}


def make_optimizers(
    name: str, network: nn.Module, share: Share = lambda tensor: None
) -> list[Optimizer]:
    """Make the optimisers that together move a network's parameters, but those held still.

    Args:
        name: as in `OPTIMIZERS`.
        network: the network.
        share: brings the first process's tensor to all of them, in place.

    Raises:
        OptionError: the name is unknown (the nearest right one is named).

    Example:
        >>> from torch import nn
        >>> len(make_optimizers("adam", nn.Linear(2, 1)))
        1
    """
    return look_up("optimizer", name, OPTIMIZERS)(network, share)
