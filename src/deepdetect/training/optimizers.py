"""Optimisers by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from ..errors import look_up

if TYPE_CHECKING:
    from torch import nn
    from torch.optim import Optimizer


def adam(network: nn.Module) -> list[Optimizer]:
    """Adam for everything."""
    import torch

    return [torch.optim.Adam(network.parameters(), fused=True)]


def soap(network: nn.Module) -> list[Optimizer]:
    """SOAP for the kernels, Adam for biases and the like."""
    import torch

    from .soap import Soap

    kernels = [parameter for parameter in network.parameters() if parameter.ndim > 1]
    vectors = [parameter for parameter in network.parameters() if parameter.ndim <= 1]
    return [Soap(kernels), torch.optim.Adam(vectors, fused=True)]


OPTIMIZERS: dict[str, Callable[[nn.Module], list[Optimizer]]] = {"adam": adam, "soap": soap}


def make_optimizers(name: str, network: nn.Module) -> list[Optimizer]:
    """Make the optimisers that together move all parameters of a network.

    Raises:
        OptionError: the name is unknown (the nearest right one is named).

    Example:
        >>> from torch import nn
        >>> len(make_optimizers("adam", nn.Linear(2, 1)))
        1
    """
    return look_up("optimizer", name, OPTIMIZERS)(network)
