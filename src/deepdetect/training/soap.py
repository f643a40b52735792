"""SOAP: Adam in the eigenbasis of Shampoo's preconditioner (arXiv:2409.11321)."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor, nn

FIRST_ITERATIONS = 3


class Soap(torch.optim.Optimizer):
    """SOAP for matrices and convolution kernels; a kernel counts as one row for each output.

    Vectors are for Adam. All of the state are tensors, by parameter, as checkpoints want.
    The first step only takes the first basis. (The libraries at hand keep one basis for
    each of a kernel's axes, three by three pixels apart, and lists in their state.)

    Args:
        parameters: tensors of two or more axes.
        lr: learning rate.
        betas: decay of the mean gradient, and of its square in the eigenbasis.
        basis_beta: decay of the two matrices whose eigenvectors are the basis.
        eps: keeps the division finite.
        basis_every: steps from one update of the basis to the next.
        share: brings the first process's tensor to all of them, in place. Each process takes
            the same steps, but bases differ by the rounding of their processors, and more and
            more so: the eigenvectors of small eigenvalues are rounding noise.

    Example:
        >>> weight = nn.Parameter(torch.ones(3, 2))
        >>> optimizer = Soap([weight], lr=0.1)
        >>> for _ in range(20):
        ...     optimizer.zero_grad()
        ...     weight.square().sum().backward()
        ...     optimizer.step()
        >>> bool(weight.square().sum() < 1)
        True
    """

    def __init__(
        self,
        parameters: Iterable[nn.Parameter],
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.95, 0.95),
        basis_beta: float = 0.95,
        eps: float = 1e-8,
        basis_every: int = 10,
        share: Callable[[Tensor], object] = lambda tensor: None,
    ) -> None:
        super().__init__(parameters, {"lr": lr})
        self.betas, self.basis_beta, self.eps = betas, basis_beta, eps
        self.basis_every = basis_every
        self.share = share

    @torch.no_grad()
    def step(self) -> None:
        """Make one step along the gradients that the parameters hold."""
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    self._step(parameter, group["lr"])

    def _step(self, parameter: nn.Parameter, rate: float) -> None:
        gradient = parameter.grad.reshape(len(parameter), -1).float().contiguous()
        state = self.state[parameter]
        if not state:
            state.update(_first_state(gradient))
            for side in ("left", "right"):
                self.share(state[f"{side}_basis"])
            return
        state["step"] = state["step"].cpu() + 1  # a checkpoint gives it back on the GPU
        left, right = state["left_basis"], state["right_basis"]
        mean, square = state["exp_avg"], state["exp_avg_sq"]
        mean.lerp_(gradient, 1 - self.betas[0])
        square.lerp_((left.T @ gradient @ right).square_(), 1 - self.betas[1])
        step = int(state["step"])
        rotated = left.T @ mean @ right / (1 - self.betas[0] ** step)
        scale = (square / (1 - self.betas[1] ** step)).sqrt_().add_(self.eps)
        change = left @ (rotated / scale) @ right.T
        parameter.add_(change.reshape(parameter.shape), alpha=-rate)
        state["left"].lerp_(gradient @ gradient.T, 1 - self.basis_beta)
        state["right"].lerp_(gradient.T @ gradient, 1 - self.basis_beta)
        if step % self.basis_every == 0:
            for axis, side in enumerate(("left", "right")):
                self._turn(state, side, axis)

    def _turn(self, state: dict[str, Tensor], side: str, axis: int) -> None:
        """Follow the eigenvectors of one side by a step of the power iteration."""
        matrix, basis = state[side], state[f"{side}_basis"]
        order = (basis.T @ matrix @ basis).diagonal().argsort(descending=True)
        self.share(order)
        state["exp_avg_sq"].copy_(state["exp_avg_sq"].index_select(axis, order))
        basis.copy_(torch.linalg.qr(matrix @ basis[:, order])[0])
        self.share(basis)


def _first_state(gradient: Tensor) -> dict[str, Tensor]:
    """Return the state of a parameter at its first gradient, as a matrix."""
    state = {
        "step": torch.zeros(()),
        "exp_avg": torch.zeros_like(gradient),
        "exp_avg_sq": torch.zeros_like(gradient),
        "left": gradient @ gradient.T,
        "right": gradient.T @ gradient,
    }
    for side in ("left", "right"):
        basis = torch.eye(len(state[side]), device=gradient.device)
        for _ in range(FIRST_ITERATIONS):
            basis = torch.linalg.qr(state[side] @ basis)[0]
        # Laid out by rows, as a checkpoint gives it back: sums round by the layout.
        state[f"{side}_basis"] = basis.contiguous()
    return state
