from __future__ import annotations

import os

import pytest

torch = pytest.importorskip("torch", reason="needs torch, which is for training only")

from hypothesis import given  # noqa: E402
from hypothesis import strategies as st  # noqa: E402

from deepdetect import OptionError  # noqa: E402
from deepdetect.detector.network.espnet import ESPNet  # noqa: E402
from deepdetect.training.engine import (  # noqa: E402
    DistributedContext,
    Engine,
    freeze_batch_norm,
    synchronize_batch_norm,
)
from deepdetect.training.recipe import DeviceOptions  # noqa: E402


def gradients(engine: Engine, images: torch.Tensor, truth: torch.Tensor) -> list[torch.Tensor]:
    engine.network.train()
    engine.network.zero_grad()
    loss = torch.nn.functional.binary_cross_entropy_with_logits(engine.logits(images), truth)
    engine.fabric.backward(loss)
    return [parameter.grad.clone() for parameter in engine.network.parameters()]


def test_gradients_in_bfloat16_are_those_of_float32_within_rounding() -> None:
    torch.manual_seed(0)
    first, second = ESPNet(), ESPNet()
    second.load_state_dict(first.state_dict())
    rgb = torch.randint(0, 256, (2, 96, 96, 3), dtype=torch.uint8)
    truth = (torch.rand(2, 1, 96, 96) < 0.4).float()
    exact = Engine(first, DeviceOptions("cpu", "float32", compile=False))
    rounded = Engine(second, DeviceOptions("cpu", "bfloat16", compile=False))
    expected = gradients(exact, exact.to_float(rgb), truth)
    found = gradients(rounded, rounded.to_float(rgb), truth)
    for name, gradient in zip(dict(first.named_parameters()), found, strict=True):
        assert torch.isfinite(gradient).all(), name
    a = torch.cat([gradient.flatten() for gradient in expected])
    b = torch.cat([gradient.flatten() for gradient in found])
    assert torch.nn.functional.cosine_similarity(a, b, dim=0) > 0.97
    assert (a - b).norm() / a.norm() < 0.25


def test_a_compiler_that_does_not_work_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*arguments: object) -> torch.Tensor:
        raise torch._dynamo.exc.TorchDynamoException("Python.h is missing")

    monkeypatch.setattr(torch, "compile", lambda *arguments, **options: broken)
    monkeypatch.setattr("shutil.which", lambda name: "/usr/bin/g++")
    images = torch.rand(1, 3, 32, 32)
    engine = Engine(ESPNet(), DeviceOptions("cpu", "float32"))
    assert engine.compiled
    assert engine.logits(images).shape == (1, 1, 32, 32)
    assert "eager" in engine.describe()
    with pytest.raises(OptionError, match="compile=False"):
        Engine(ESPNet(), DeviceOptions("cpu", "float32", compile=True)).logits(images)


@pytest.mark.skipif(
    not os.environ.get("DEEPDETECT_TEST_COMPILE"),
    reason="takes minutes: set DEEPDETECT_TEST_COMPILE=1",
)
def test_compiled_training_gives_the_eager_gradients() -> None:
    torch.manual_seed(0)
    first, second = ESPNet(), ESPNet()
    second.load_state_dict(first.state_dict())
    rgb = torch.randint(0, 256, (2, 64, 64, 3), dtype=torch.uint8)
    truth = (torch.rand(2, 1, 64, 64) < 0.4).float()
    eager = Engine(first, DeviceOptions("cpu", "float32", compile=False))
    compiled = Engine(second, DeviceOptions("cpu", "float32", compile=True))
    for a, b in zip(
        gradients(eager, eager.to_float(rgb), truth),
        gradients(compiled, compiled.to_float(rgb), truth),
        strict=True,
    ):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-3)


@given(processes=st.integers(1, 9), part=st.integers(1, 9))
def test_shares_cover_everything_once(processes: int, part: int) -> None:
    count = processes * part
    seen = [
        k
        for rank in range(processes)
        for k in range(count)[
            DistributedContext(rank, processes, rank, processes).local_slice(count)
        ]
    ]
    assert seen == list(range(count))


def test_the_context_is_read_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TORCHELASTIC_RUN_ID", raising=False)
    monkeypatch.setenv("RANK", "3")
    assert DistributedContext.from_environment() == DistributedContext(), (
        "a variable of another program starts no distributed run"
    )
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "run")
    monkeypatch.setenv("WORLD_SIZE", "8")
    monkeypatch.setenv("LOCAL_RANK", "1")
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    context = DistributedContext.from_environment()
    assert context == DistributedContext(3, 8, 1, 2)
    assert context.machines == 4
    assert not context.is_main
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "3")
    with pytest.raises(OptionError, match="as many processes on each machine"):
        DistributedContext.from_environment()


def test_images_become_floats_and_values_come_back_alone() -> None:
    engine = Engine(torch.nn.Conv2d(3, 1, 1), DeviceOptions("cpu", "float32", compile=False))
    rgb = torch.randint(0, 256, (2, 8, 6, 3), dtype=torch.uint8)
    found = engine.to_float(rgb)
    assert found.is_contiguous(memory_format=torch.channels_last)
    torch.testing.assert_close(found, rgb.permute(0, 3, 1, 2) / 255)
    assert engine.all_gather({"a": 1}) == [{"a": 1}]
    assert engine.all_reduce_mean(torch.tensor(3.0)) == 3
    assert engine.describe() == "cpu, float32, eager"
    engine.context.barrier()
    engine.close()


def test_frozen_batch_norm_keeps_its_statistics() -> None:
    network = torch.nn.Sequential(torch.nn.BatchNorm2d(3), torch.nn.Dropout(0.5)).train()
    freeze_batch_norm(network)
    network(torch.rand(2, 3, 8, 8))
    assert torch.equal(network[0].running_mean, torch.zeros(3))
    assert network[1].training


def test_batch_norm_over_one_process_is_that_of_torch(tmp_path) -> None:
    torch.distributed.init_process_group(
        "gloo", init_method=f"file://{tmp_path / 'store'}", rank=0, world_size=1
    )
    try:
        torch.manual_seed(0)
        plain, synchronized = torch.nn.BatchNorm2d(4), torch.nn.BatchNorm2d(4)
        synchronize_batch_norm(torch.nn.Sequential(synchronized), torch.device("cpu"))
        x = torch.randn(3, 4, 6, 5, requires_grad=True)
        y = x.detach().clone().requires_grad_()
        for norm, value in ((plain, x), (synchronized, y)):
            (norm(value) * torch.arange(5)).sin().sum().backward()
        torch.testing.assert_close(y.grad, x.grad)
        torch.testing.assert_close(synchronized.weight.grad, plain.weight.grad)
        for name, value in plain.named_buffers():
            torch.testing.assert_close(dict(synchronized.named_buffers())[name], value)
        torch.testing.assert_close(synchronized.eval()(y), plain.eval()(x))
    finally:
        torch.distributed.destroy_process_group()
