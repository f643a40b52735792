"""Batch normalisation followed by PReLU, fast when it is trained in bfloat16 on a CPU.

The loops of norm_activation.cpp read every map twice and make nothing in between, where the
code that torch 2.13 compiles passes through maps in float32 (docs/training.md, Speed).
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import batch_norm, prelu

from .native import native_library


def normalize_and_activate(x: Tensor, norm: nn.BatchNorm2d, activation: nn.PReLU) -> Tensor:
    """Normalise a (B, C, H, W) map and apply the PReLU.

    Args:
        x: the map.
        norm: a batch normalisation of C channels.
        activation: a PReLU of C slopes.

    Returns:
        (B, C, H, W), what `activation(norm(x))` is but for rounding to bfloat16 once, not twice.

    Example:
        >>> normalize_and_activate(torch.ones(1, 2, 4, 4), nn.BatchNorm2d(2), nn.PReLU(2)).sum()
        tensor(0., grad_fn=<SumBackward0>)
    """
    return join_and_activate([x], norm, activation)


def join_and_activate(
    parts: Sequence[Tensor], norm: nn.BatchNorm2d, activation: nn.PReLU
) -> Tensor:
    """Join maps by their channels, normalise them and apply the PReLU.

    Args:
        parts: (B, C, H, W) maps. One in float32 does not make the others so.
        norm: a batch normalisation of all their channels.
        activation: a PReLU of all their channels.

    Returns:
        (B, sum of C, H, W).
    """
    if not (_fits(parts, norm, activation) and any(map(_is_fast, parts))):
        return activation(norm(torch.cat(list(parts), 1) if len(parts) > 1 else parts[0]))
    made = []
    first = 0
    for part in parts:
        own = slice(first, first + part.shape[1])
        first = own.stop
        weight, bias, slope = norm.weight[own], norm.bias[own], activation.weight[own]
        mean, variance = norm.running_mean[own], norm.running_var[own]
        if _is_fast(part):
            result, new_mean, new_variance = _forward(part, weight, bias, slope, norm.eps)
            count = part.numel() // part.shape[1]
            mean.lerp_(new_mean.detach().float(), norm.momentum)
            unbiased = new_variance.detach() * (count / (count - 1))
            variance.lerp_(unbiased.float(), norm.momentum)
        else:
            normal = batch_norm(part, mean, variance, weight, bias, True, norm.momentum, norm.eps)
            result = prelu(normal, slope)
        made.append(result)
    norm.num_batches_tracked.add_(1)
    return torch.cat(made, 1) if len(made) > 1 else made[0]


def _fits(parts: Sequence[Tensor], norm: nn.BatchNorm2d, activation: nn.PReLU) -> bool:
    """Whether these layers are what the loops do; torch does, or refuses, all else."""
    channels = sum(part.shape[1] for part in parts)
    return (
        type(norm) is nn.BatchNorm2d  # not one whose statistics are of several processes
        and norm.training
        and norm.affine
        and norm.track_running_stats
        and norm.momentum is not None
        and channels == norm.num_features == activation.num_parameters
        and norm.weight.dtype == activation.weight.dtype == torch.float32
        and parts[0].numel() > parts[0].shape[1]  # one pixel has no variance
    )


def _is_fast(x: Tensor) -> bool:
    return x.dtype == torch.bfloat16 and x.device.type == "cpu" and _loops_exist()


@torch.compiler.assume_constant_result
def _loops_exist() -> bool:
    return native_library("norm_activation") is not None


@torch.library.custom_op("deepdetect::norm_activation", mutates_args=(), device_types="cpu")
def _forward(
    x: Tensor, weight: Tensor, bias: Tensor, slope: Tensor, epsilon: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the activated map, and the channels' means and biased variances in float64."""
    x = _dense(x)
    made = torch.empty_like(x)
    mean, variance = (torch.empty_like(weight, dtype=torch.float64) for _ in range(2))
    native_library("norm_activation").forward(
        _pointer(x), *_size(x), *_floats(weight, bias, slope), ctypes.c_double(epsilon),
        *map(_pointer, (mean, variance, made)),
    )  # fmt: skip
    return made, mean, variance


@torch.library.custom_op(
    "deepdetect::norm_activation_backward", mutates_args=(), device_types="cpu"
)
def _backward(
    gradient: Tensor,
    x: Tensor,
    weight: Tensor,
    bias: Tensor,
    slope: Tensor,
    mean: Tensor,
    variance: Tensor,
    epsilon: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the gradients of x, weight, bias and slope."""
    x, gradient = _dense(x), _dense(gradient)
    made = torch.empty_like(x), *(torch.empty_like(weight) for _ in range(3))
    native_library("norm_activation").backward(
        _pointer(x), _pointer(gradient), *_size(x), *_floats(weight, bias, slope),
        _pointer(mean), _pointer(variance), ctypes.c_double(epsilon), *map(_pointer, made),
    )  # fmt: skip
    return made


def _dense(x: Tensor) -> Tensor:
    return x.contiguous(memory_format=torch.channels_last)


def _pointer(x: Tensor) -> ctypes.c_void_p:
    return ctypes.c_void_p(x.data_ptr())


def _floats(*of_channels: Tensor) -> list[ctypes.Array]:
    return [(ctypes.c_float * x.numel())(*x.tolist()) for x in of_channels]


def _size(x: Tensor) -> tuple[ctypes.c_int64, ctypes.c_int64]:
    """Return the channels and the pixels."""
    return ctypes.c_int64(x.shape[1]), ctypes.c_int64(x.numel() // x.shape[1])


@_forward.register_fake
def _(x: Tensor, weight: Tensor, *_: Any) -> tuple[Tensor, Tensor, Tensor]:
    made = torch.empty_like(x, memory_format=torch.channels_last)
    return made, *(torch.empty_like(weight, dtype=torch.float64) for _ in range(2))


@_backward.register_fake
def _(gradient: Tensor, x: Tensor, weight: Tensor, *_: Any) -> tuple[Tensor, ...]:
    of_x = torch.empty_like(x, memory_format=torch.channels_last)
    return of_x, *(torch.empty_like(weight) for _ in range(3))


def _keep(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    *tensors, ctx.epsilon = inputs
    ctx.save_for_backward(*tensors, *output[1:])


def _pass_back(ctx: Any, gradient: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
    return *_backward(_dense(gradient), *ctx.saved_tensors, ctx.epsilon), None


_forward.register_autograd(_pass_back, setup_context=_keep)
