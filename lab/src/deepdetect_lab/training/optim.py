"""Optimisers: Adam and SOAP by name, and Muon."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

BETA = 0.95
"""Decay per step of the running means of `Soap`, as in its paper, and of the momentum of `Muon`."""

EPS = 1e-8
"""Number added to denominators in `Soap`, as by default in torch's Adam."""

PRECONDITION_FREQUENCY = 10
"""Number of steps between updates of the eigenbasis of `Soap`, as in its paper."""

NEWTON_SCHULZ = (3.4445, -4.775, 2.0315)
"""Coefficients of the powers 1, 3 and 5 of a polynomial. Applied repeatedly to singular values, the
polynomial moves them close to 1 (Keller Jordan, "Muon")."""

NEWTON_SCHULZ_STEPS = 5
"""Number of applications of the polynomial, as in Keller Jordan's Muon."""

MUON_RMS = 0.2
"""Root mean square of the elements of a Muon step, in units of the learning rate. Steps of Adam are
about as large (arXiv:2502.16982)."""

MUON_WEIGHT_DECAY = 0.01
"""Weight decay per step, divided by the learning rate, as by default in torch's AdamW."""

INITIAL_POWER_ITERATIONS = 3
"""Number of power iterations from the identity to `Soap`'s first eigenbasis. Chosen by hand."""


def make_optimizers(name: str, network: nn.Module) -> list[Optimizer]:
    """Make the optimisers that together train a network's parameters.

    "adam" is Adam for all parameters. "soap" is SOAP for kernels, and Adam for vectors (biases).
    """
    if name == "adam":
        return [torch.optim.Adam(network.parameters(), fused=True)]
    kernels = [parameter for parameter in network.parameters() if parameter.ndim > 1]
    vectors = [parameter for parameter in network.parameters() if parameter.ndim <= 1]
    return [Soap(kernels), torch.optim.Adam(vectors, fused=True)]


class KernelOptimizer(Optimizer):
    """An optimiser of matrices and convolution kernels.

    A kernel is treated as a matrix with one row for each output channel. The state consists of
    tensors only, so that safetensors can store it, and a resumed run is bit-identical.
    """

    def __init__(self, parameters: Iterable[Any], lr: float = 1e-3) -> None:
        super().__init__(parameters, {"lr": lr})

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]  # takes no closure
        """Make one step along the gradients of the parameters."""
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    gradient = parameter.grad.reshape(len(parameter), -1).float().contiguous()
                    self._step(parameter, gradient, group["lr"])

    def _step(self, parameter: nn.Parameter, gradient: Tensor, learning_rate: float) -> None:
        raise NotImplementedError


class Soap(KernelOptimizer):
    """SOAP (arXiv:2409.11321): Adam in the eigenbasis of Shampoo's preconditioner.

    The first step only computes the first eigenbasis. The SOAP of the package pytorch-optimizer is
    not used, because its state also holds lists and numbers, which safetensors cannot store.
    """

    def _step(self, parameter: nn.Parameter, gradient: Tensor, learning_rate: float) -> None:
        state = self.state[parameter]
        if not state:
            state.update(_initial_state(gradient))
            return
        state["step"] = state["step"].cpu() + 1  # loading a checkpoint puts it on the GPU
        left, right = state["left_basis"], state["right_basis"]
        mean, square = state["exp_avg"], state["exp_avg_sq"]
        mean.lerp_(gradient, 1 - BETA)
        square.lerp_((left.T @ gradient @ right).square_(), 1 - BETA)
        step = int(state["step"])
        rotated = left.T @ mean @ right / (1 - BETA**step)
        scale = (square / (1 - BETA**step)).sqrt_().add_(EPS)
        change = left @ (rotated / scale) @ right.T
        parameter.add_(change.reshape(parameter.shape), alpha=-learning_rate)
        state["left"].lerp_(gradient @ gradient.T, 1 - BETA)
        state["right"].lerp_(gradient.T @ gradient, 1 - BETA)
        if step % PRECONDITION_FREQUENCY == 0:
            for axis, side in enumerate(("left", "right")):
                _update_basis(state, side, axis)


def _update_basis(state: dict[str, Tensor], side: str, axis: int) -> None:
    """Update the eigenvectors of the left or right preconditioner by one power iteration."""
    matrix, basis = state[side], state[f"{side}_basis"]
    order = (basis.T @ matrix @ basis).diagonal().argsort(descending=True)
    state["exp_avg_sq"].copy_(state["exp_avg_sq"].index_select(axis, order))
    basis.copy_(torch.linalg.qr(matrix @ basis[:, order])[0])


def _initial_state(gradient: Tensor) -> dict[str, Tensor]:
    state = {
        "step": torch.zeros(()),
        "exp_avg": torch.zeros_like(gradient),
        "exp_avg_sq": torch.zeros_like(gradient),
        "left": gradient @ gradient.T,
        "right": gradient.T @ gradient,
    }
    for side in ("left", "right"):
        basis = torch.eye(len(state[side]), device=gradient.device)
        for _ in range(INITIAL_POWER_ITERATIONS):
            basis = torch.linalg.qr(state[side] @ basis)[0]
        # The basis is made contiguous, as in a checkpoint, because rounding depends on the layout.
        state[f"{side}_basis"] = basis.contiguous()
    return state


class Muon(KernelOptimizer):
    """Muon (Keller Jordan, 2024): momentum, orthogonalised as a matrix before each step."""

    def _step(self, parameter: nn.Parameter, gradient: Tensor, learning_rate: float) -> None:
        mean = self.state[parameter].setdefault("mean", torch.zeros_like(gradient))
        mean.lerp_(gradient, 1 - BETA)
        change = _orthogonalized(gradient.lerp(mean, BETA)).reshape(parameter.shape)
        scale = learning_rate * MUON_RMS * math.sqrt(max(gradient.shape))
        parameter.mul_(1 - MUON_WEIGHT_DECAY * learning_rate).add_(change, alpha=-scale)


def _orthogonalized(matrix: Tensor) -> Tensor:
    """Orthogonalise a matrix: keep its singular vectors, and map singular values to about 1."""
    tall = matrix.shape[0] > matrix.shape[1]
    x = (matrix.T if tall else matrix) / (matrix.norm() + 1e-7)
    x = x.bfloat16()
    linear, cubic, quintic = NEWTON_SCHULZ
    for _ in range(NEWTON_SCHULZ_STEPS):
        product = x @ x.T
        x = linear * x + (cubic * product + quintic * product @ product) @ x
    return (x.T if tall else x).float()
