from __future__ import annotations

import copy

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from deepdetect.detector.network import norm_activation
from deepdetect.detector.network.native import native_library
from deepdetect.detector.network.norm_activation import join_and_activate, normalize_and_activate

needs_compiler = pytest.mark.skipif(
    native_library("norm_activation") is None, reason="no C++ compiler with OpenMP"
)


def layers(channels: int) -> tuple[nn.BatchNorm2d, nn.PReLU]:
    """A batch normalisation and a PReLU with all signs, and a gain and a slope of zero."""
    norm, activation = nn.BatchNorm2d(channels, eps=1e-3), nn.PReLU(channels)
    with torch.no_grad():
        norm.weight.copy_(torch.randn(channels))
        norm.bias.copy_(torch.randn(channels))
        norm.running_mean.copy_(torch.randn(channels))
        norm.running_var.copy_(torch.rand(channels) + 0.5)
        activation.weight.copy_(torch.randn(channels) * 0.5)
        norm.weight[0] = activation.weight[-1] = 0
    return norm, activation


def map_of(batch: int, channels: int, height: int, width: int) -> Tensor:
    spread, mean = torch.rand(2, channels, 1, 1)
    x = torch.randn(batch, channels, height, width) * (spread + 0.1) + 4 * mean
    return x.bfloat16().to(memory_format=torch.channels_last)


def gradients(made: Tensor, wanted: Tensor, *of: Tensor) -> tuple[Tensor, ...]:
    return torch.autograd.grad((made.double() * wanted.double()).sum(), of, retain_graph=True)


def assert_near(found: Tensor, expected: Tensor, share: float) -> None:
    assert (found.double() - expected.double()).norm() <= share * expected.double().norm() + 1e-6


@needs_compiler
@settings(max_examples=25, deadline=None)
@given(
    channels=st.sampled_from([1, 2, 3, 10, 16, 20, 33, 64, 128]),
    batch=st.integers(1, 3),
    height=st.integers(2, 23),
    width=st.integers(2, 23),
    seed=st.integers(0, 2**16),
)
def test_values_statistics_and_gradients_are_those_of_torch_in_float64(
    channels: int, batch: int, height: int, width: int, seed: int
) -> None:
    torch.manual_seed(seed)
    norm, activation = layers(channels)
    exact_norm, exact_activation = copy.deepcopy(norm).double(), copy.deepcopy(activation).double()
    x = map_of(batch, channels, height, width).requires_grad_()
    exact_x = x.detach().double().requires_grad_()
    wanted = map_of(batch, channels, height, width)

    made = normalize_and_activate(x, norm, activation)
    exact = exact_activation(exact_norm(exact_x))

    assert made.dtype == torch.bfloat16
    assert made.is_contiguous(memory_format=torch.channels_last)
    assert_near(made, exact, 2**-8)
    for name, value in exact_norm.named_buffers():
        torch.testing.assert_close(
            norm.get_buffer(name).double(), value.double(), rtol=1e-5, atol=1e-5
        )
    own = gradients(made, wanted, x, norm.weight, norm.bias, activation.weight)
    right = gradients(
        exact, wanted, exact_x, exact_norm.weight, exact_norm.bias, exact_activation.weight
    )
    assert_near(own[0], right[0], 2**-7)
    for found, expected in zip(own[1:], right[1:], strict=True):
        # A value that rounds to just the other side of zero has another slope.
        assert_near(found, expected, 1e-3)


@needs_compiler
def test_a_mean_far_from_zero_costs_no_digits_of_the_variance() -> None:
    torch.manual_seed(0)
    norm, activation = layers(16)
    x = (torch.randn(8, 16, 60, 60) + 100).bfloat16().to(memory_format=torch.channels_last)
    norm.momentum = 1.0
    normalize_and_activate(x, norm, activation)
    variance, mean = torch.var_mean(x.double(), (0, 2, 3))
    torch.testing.assert_close(norm.running_mean.double(), mean, rtol=1e-6, atol=0)
    torch.testing.assert_close(norm.running_var.double(), variance, rtol=1e-5, atol=0)


@needs_compiler
def test_parts_of_several_types_are_joined_as_torch_would_within_rounding(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    torch.manual_seed(1)
    norm, activation = layers(64 + 16 + 3)
    other_norm, other_activation = copy.deepcopy(norm), copy.deepcopy(activation)
    parts = [map_of(2, 64, 12, 20), map_of(2, 16, 12, 20), torch.rand(2, 3, 12, 20)]
    with torch.autocast("cpu", torch.bfloat16):
        made = join_and_activate(parts, norm, activation)
        with monkeypatch.context() as without:
            without.setattr(norm_activation, "native_library", lambda name: None)
            expected = join_and_activate(parts, other_norm, other_activation)
    wanted = torch.randn(made.shape)
    for layer, other in ((norm, other_norm), (activation, other_activation)):
        (found,) = gradients(made, wanted, layer.weight)
        (right,) = gradients(expected, wanted, other.weight)
        assert_near(found, right, 0.02)
    assert made.dtype == expected.dtype == torch.bfloat16, "the photograph widens nothing"
    assert_near(made, expected, 2**-7)
    for name, value in other_norm.named_buffers():
        torch.testing.assert_close(norm.get_buffer(name), value, rtol=1e-4, atol=1e-4)


@needs_compiler
def test_gradients_that_are_a_slice_of_others_are_read_rightly() -> None:
    torch.manual_seed(2)
    norm, activation = layers(16)
    x = map_of(2, 16, 10, 14).requires_grad_()
    wide = map_of(2, 40, 10, 14)
    made = normalize_and_activate(x, norm, activation)
    (sliced,) = torch.autograd.grad(made, x, wide[:, 8:24], retain_graph=True)
    (dense,) = torch.autograd.grad(made, x, wide[:, 8:24].contiguous())
    assert torch.equal(sliced, dense)


@needs_compiler
def test_the_same_maps_give_the_same_bits() -> None:
    torch.manual_seed(3)
    x, wanted = map_of(8, 20, 61, 47).requires_grad_(), map_of(8, 20, 61, 47)
    results = []
    for _ in range(5):
        torch.manual_seed(4)
        norm, activation = layers(20)
        made = normalize_and_activate(x, norm, activation)
        found = gradients(made, wanted, x, norm.weight, norm.bias, activation.weight)
        results.append((made, norm.running_var, *found))
    assert all(torch.equal(a, b) for r in results for a, b in zip(r, results[0], strict=True))


@needs_compiler
def test_what_is_not_finite_stays_so() -> None:
    norm, activation = layers(16)
    x = map_of(1, 16, 8, 8)
    x[0, 3, 2, 2] = torch.nan
    made = normalize_and_activate(x, norm, activation)
    assert made[:, 3].isnan().all()
    assert made[:, :3].isfinite().all()
    assert norm.running_mean[3].isnan()
    assert norm.running_var[3].isnan()
    assert norm.running_var[:3].isfinite().all()


@needs_compiler
def test_the_operators_are_what_they_tell_torch_of_themselves() -> None:
    torch.manual_seed(5)
    x = map_of(2, 20, 6, 5).requires_grad_()
    parameters = [torch.randn(20, requires_grad=True) for _ in range(3)]
    torch.library.opcheck(
        torch.ops.deepdetect.norm_activation.default,
        (x, *parameters, 1e-3),
        test_utils=("test_schema", "test_autograd_registration", "test_faketensor"),
    )


@needs_compiler
def test_compiled_by_torch_it_is_the_same() -> None:
    torch.manual_seed(7)
    norm, activation = layers(19)
    other_norm, other_activation = copy.deepcopy(norm), copy.deepcopy(activation)
    x, photograph = map_of(2, 16, 12, 20).requires_grad_(), torch.rand(2, 3, 12, 20)
    wanted = torch.randn(2, 19, 12, 20)

    def run(norm: nn.BatchNorm2d, activation: nn.PReLU) -> Tensor:
        return join_and_activate([x * 2, photograph], norm, activation).float() * 3

    with torch.autocast("cpu", torch.bfloat16):
        expected = run(norm, activation)
        made = torch.compile(run, dynamic=False, fullgraph=True)(other_norm, other_activation)
    assert_near(made, expected, 2**-8)
    for name, value in norm.named_buffers():
        torch.testing.assert_close(other_norm.get_buffer(name), value, rtol=1e-5, atol=1e-5)
    right = gradients(expected, wanted, x, norm.weight, norm.bias, activation.weight)
    found = gradients(made, wanted, x, other_norm.weight, other_norm.bias, other_activation.weight)
    for a, b in zip(found, right, strict=True):
        assert_near(a, b, 0.01)


@pytest.mark.parametrize(
    ("layers_of", "error"),
    [
        (lambda: (nn.BatchNorm2d(8), nn.PReLU(8)), "running_mean"),
        (lambda: (nn.BatchNorm2d(2), nn.PReLU(2)), "running_mean"),
        (lambda: (nn.BatchNorm2d(4), nn.PReLU(2).bfloat16()), "channel size"),
    ],
)
def test_layers_of_other_channels_are_refused_as_torch_does(layers_of, error: str) -> None:
    with pytest.raises(RuntimeError, match=error):
        normalize_and_activate(map_of(2, 4, 6, 5), *layers_of())


@pytest.mark.parametrize(
    "norm",
    [
        nn.BatchNorm2d(20, momentum=None),
        nn.BatchNorm2d(20, affine=False),
        nn.BatchNorm2d(20, track_running_stats=False),
    ],
)
def test_other_kinds_of_layers_are_left_to_torch(norm: nn.BatchNorm2d) -> None:
    x, activation = map_of(2, 20, 6, 5), nn.PReLU().bfloat16()
    expected = activation(copy.deepcopy(norm)(x))
    assert torch.equal(normalize_and_activate(x, norm, activation), expected)


@pytest.mark.parametrize("kind", ["float32", "evaluation", "no compiler"])
def test_elsewhere_it_is_torch_itself(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(6)
    norm, activation = layers(20)
    x = map_of(2, 20, 6, 5)
    if kind == "float32":
        x = x.float()
    elif kind == "evaluation":
        norm.eval()
    else:
        monkeypatch.setattr(norm_activation, "native_library", lambda name: None)
    expected = activation.bfloat16()(copy.deepcopy(norm)(x)) if kind != "float32" else None
    if expected is None:
        expected = activation(copy.deepcopy(norm)(x))
    assert torch.equal(normalize_and_activate(x, norm, activation), expected)
