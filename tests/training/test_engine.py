from __future__ import annotations

import os

import pytest

torch = pytest.importorskip("torch", reason="needs torch, which is for training only")

from deepdetect import OptionError  # noqa: E402
from deepdetect.detector.network.espnet import ESPNet  # noqa: E402
from deepdetect.training.engine import Engine, freeze_batch_norm, launch  # noqa: E402
from deepdetect.training.recipe import DeviceOptions  # noqa: E402


def make_engine(network: torch.nn.Module, options: DeviceOptions) -> Engine:
    return Engine(network, options, launch(options))


def gradients(engine: Engine, images: torch.Tensor, truth: torch.Tensor) -> list[torch.Tensor]:
    engine.network.train()
    engine.network.zero_grad()
    loss = torch.nn.functional.binary_cross_entropy_with_logits(engine.logits(images), truth)
    engine.fabric.backward(loss)
    return [parameter.grad.clone() for parameter in engine.network.parameters()]


def two_engines(side: int, options: DeviceOptions) -> tuple[list[torch.Tensor], ...]:
    """Return the gradients of one network, by an eager engine in float32 and by another one."""
    torch.manual_seed(0)
    first, second = ESPNet(), ESPNet()
    second.load_state_dict(first.state_dict())
    rgb = torch.randint(0, 256, (2, side, side, 3), dtype=torch.uint8)
    truth = (torch.rand(2, 1, side, side) < 0.4).float()
    plain = make_engine(first, DeviceOptions("cpu", "float32", compile=False))
    other = make_engine(second, options)
    return tuple(gradients(engine, engine.to_float(rgb), truth) for engine in (plain, other))


def test_gradients_in_bfloat16_are_those_of_float32_within_rounding() -> None:
    expected, found = two_engines(96, DeviceOptions("cpu", "bfloat16", compile=False))
    a, b = (torch.cat([gradient.flatten() for gradient in each]) for each in (expected, found))
    assert torch.isfinite(b).all()
    assert torch.nn.functional.cosine_similarity(a, b, dim=0) > 0.97
    assert (a - b).norm() / a.norm() < 0.25


def test_a_compiler_that_does_not_work_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*arguments: object) -> torch.Tensor:
        raise torch._dynamo.exc.TorchDynamoException("Python.h is missing")

    monkeypatch.setattr(torch, "compile", lambda *arguments, **options: broken)
    monkeypatch.setattr("shutil.which", lambda name: "/usr/bin/g++")
    images = torch.rand(1, 3, 32, 32)
    engine = make_engine(ESPNet(), DeviceOptions("cpu", "float32"))
    assert engine.compiled
    assert engine.logits(images).shape == (1, 1, 32, 32)
    assert "eager" in engine.describe()
    with pytest.raises(OptionError, match="compile=False"):
        make_engine(ESPNet(), DeviceOptions("cpu", "float32", compile=True)).logits(images)


@pytest.mark.skipif(
    not os.environ.get("DEEPDETECT_TEST_COMPILE"),
    reason="takes minutes: set DEEPDETECT_TEST_COMPILE=1",
)
def test_compiled_training_gives_the_eager_gradients() -> None:
    expected, found = two_engines(64, DeviceOptions("cpu", "float32", compile=True))
    for a, b in zip(expected, found, strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-3)


def test_frozen_batch_norm_keeps_its_statistics() -> None:
    network = torch.nn.Sequential(torch.nn.BatchNorm2d(3), torch.nn.Dropout(0.5)).train()
    freeze_batch_norm(network)
    network(torch.rand(2, 3, 8, 8))
    assert torch.equal(network[0].running_mean, torch.zeros(3))
    assert network[1].training
