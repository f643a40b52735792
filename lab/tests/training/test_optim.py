"""SOAP against what its paper says of it."""

from __future__ import annotations

import pytest
import torch

from deepdetect_lab.networks.espnet import ESPNet
from deepdetect_lab.training.optim import Muon, Soap, make_optimizers


def ill_conditioned(size: int = 6) -> tuple[torch.Tensor, torch.Tensor]:
    """Two random symmetric matrices with eigenvalues from 1 to 1e-3."""
    generator = torch.Generator().manual_seed(3)
    made = []
    for _ in range(2):
        basis = torch.linalg.qr(torch.randn(size, size, generator=generator))[0]
        made.append(basis @ torch.diag(torch.logspace(0, -3, size)) @ basis.T)
    return made[0], made[1]


def minimise(optimizer_of, start: torch.Tensor, steps: int = 400) -> float:
    """Minimise |A W B|^2 and return the last value."""
    left, right = ill_conditioned()
    weight = torch.nn.Parameter(start.clone())
    optimizer = optimizer_of([weight])
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = 0.05 * (1 - step / steps)
        optimizer.zero_grad()
        loss = (left @ weight @ right).square().sum()
        loss.backward()
        optimizer.step()
    return float(loss.detach())


def test_a_badly_conditioned_problem_is_solved_better_than_by_adam() -> None:
    start = torch.randn(6, 6, generator=torch.Generator().manual_seed(4))
    assert minimise(Soap, start) < 0.1 * minimise(torch.optim.Adam, start)


def test_with_a_fixed_basis_of_the_axes_it_is_adam(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(5)
    start = torch.randn(4, 3, generator=generator)
    gradients = torch.randn(12, 4, 3, generator=generator)
    ours, theirs = torch.nn.Parameter(start.clone()), torch.nn.Parameter(start.clone())
    monkeypatch.setattr("deepdetect_lab.training.optim.PRECONDITION_FREQUENCY", 1000)
    soap = Soap([ours], lr=0.01)
    adam = torch.optim.Adam([theirs], lr=0.01, betas=(0.95, 0.95))
    for k, gradient in enumerate(gradients):
        ours.grad = gradient.clone()
        soap.step()
        if k == 0:  # the first gradient only gives the basis
            state = soap.state[ours]
            state["left_basis"], state["right_basis"] = torch.eye(4), torch.eye(3)
            continue
        theirs.grad = gradient.clone()
        adam.step()
    torch.testing.assert_close(ours, theirs)


def test_the_basis_stays_orthonormal_and_the_moments_follow_it() -> None:
    generator = torch.Generator().manual_seed(7)
    weight = torch.nn.Parameter(torch.zeros(4, 3, 3, 3))
    optimizer = Soap([weight])
    for _ in range(35):
        weight.grad = torch.randn(4, 3, 3, 3, generator=generator)
        optimizer.step()
    state = optimizer.state[weight]
    for side, size in (("left", 4), ("right", 27)):
        basis = state[f"{side}_basis"]
        torch.testing.assert_close(basis.T @ basis, torch.eye(size), atol=1e-5, rtol=0)
    # The mean square is that of the rotated gradient: its sum does not depend on the basis.
    assert 0.8 < float(state["exp_avg_sq"].mean()) < 1.2


@pytest.mark.parametrize("name", ["adam", "soap"])
def test_every_parameter_of_the_network_is_moved_by_one_optimiser(name: str) -> None:
    network = ESPNet()
    optimizers = make_optimizers(name, network)
    held = [p for o in optimizers for group in o.param_groups for p in group["params"]]
    assert sorted(map(id, held)) == sorted(map(id, network.parameters()))


def test_muon_moves_in_all_directions_alike() -> None:
    generator = torch.Generator().manual_seed(1)
    weights = torch.nn.Parameter(torch.randn(6, 4, 3, 3, generator=generator))
    before, gradient = weights.detach().clone(), torch.randn(6, 36, generator=generator)
    weights.grad = (gradient * torch.logspace(0, -2, 6)[:, None]).reshape(weights.shape)
    Muon([weights], lr=0.01).step()
    change = (weights.detach() - before * (1 - 0.01 * 0.01)).reshape(6, 36)
    singular = torch.linalg.svdvals(change / (0.01 * 0.2 * 6))
    assert singular.min() > 0.4  # the polynomial brings them near 1, not to it
    assert singular.max() < 1.4
    assert (change * weights.grad.reshape(6, 36)).sum() < 0
