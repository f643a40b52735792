from __future__ import annotations

import csv
import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs torch, which is for training only")

from safetensors.torch import load_file  # noqa: E402

from deepdetect import DeepDetect, ImageError, OptionError, WeightsError  # noqa: E402
from deepdetect.detector.network.espnet import ESPNet  # noqa: E402
from deepdetect.detector.network.weights import (  # noqa: E402
    average_weights,
    load_network,
    read_notes,
    save_weights,
    weights_digest,
)
from deepdetect.detector.pretrained import pretrained_weights  # noqa: E402
from deepdetect.training.checkpoint import read_checkpoint, restore, save_checkpoint  # noqa: E402
from deepdetect.training.device import DeviceOptions, Engine  # noqa: E402
from deepdetect.training.recipe import Stage, TrainingOptions  # noqa: E402
from deepdetect.training.trainer import train  # noqa: E402

PLAIN = DeviceOptions("cpu", "float32", compile=False, threads=1)
RECIPE = ["--stage", "64x4x8", "--stage", "96x2x2", "--short-side", "96", "--short-side", "64"]


def command(photographs: Path, run: Path, labels: Path) -> list[str]:
    """The same tiny run as a command of its own, which can be killed."""
    return [
        *(sys.executable, "-m", "deepdetect", "train", str(photographs), "-o", str(run)),
        *("--labels", str(labels), "--val-count", "8", "--detectors", "fast,sobel"),
        *("--precision", "float32", "--no-compile", "--threads", "1", "--workers", "1", "--json"),
        *RECIPE,
    ]


def tensors_equal(a: Path, b: Path) -> bool:
    first, second = load_file(a), load_file(b)
    return first.keys() == second.keys() and all(
        torch.equal(first[name], second[name]) for name in first
    )


@pytest.fixture(scope="module")
def unbroken(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("unbroken")
    labels = run.parent / "labels"
    subprocess.run(command(photographs, run, labels), check=True, capture_output=True)
    return run


@pytest.fixture(scope="module")
def unbroken_soap(photographs: Path, unbroken: Path) -> Path:
    run = unbroken.parent / "unbroken_soap"
    arguments = [*command(photographs, run, unbroken.parent / "labels"), "--optimizer", "soap"]
    subprocess.run(arguments, check=True, capture_output=True)
    return run


@pytest.mark.parametrize("optimizer", ["adam", "soap"])
def test_a_killed_run_ends_with_the_same_weights(
    optimizer: str, photographs: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    unbroken = request.getfixturevalue("unbroken" if optimizer == "adam" else "unbroken_soap")
    run, labels = tmp_path / "killed", unbroken.parent / "labels"
    arguments = [*command(photographs, run, labels), "--optimizer", optimizer]
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    deadline = time.monotonic() + 120
    while not (run / "checkpoint.safetensors").exists() and time.monotonic() < deadline:
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL, "the run must be killed before its end"
    steps_done = _steps(run)
    assert 0 < steps_done < _steps(unbroken)

    subprocess.run(arguments, check=True, capture_output=True)
    assert tensors_equal(run / "best.safetensors", unbroken / "best.safetensors")
    assert tensors_equal(run / "checkpoint.safetensors", unbroken / "checkpoint.safetensors")
    assert (run / "curves.csv").read_text() == (unbroken / "curves.csv").read_text()


def _steps(run: Path) -> int:
    tensors = load_file(run / "checkpoint.safetensors")
    return int(next(value for name, value in tensors.items() if name.startswith("optimizer.step.")))


def test_a_run_writes_weights_and_curves(unbroken: Path) -> None:
    names = {path.name for path in unbroken.iterdir()}
    assert names >= {
        "best.safetensors",
        "checkpoint.safetensors",
        "curves.csv",
        "curves.png",
        "deepdetect.onnx",
    }
    rows = list(csv.DictReader((unbroken / "curves.csv").read_text().splitlines()))
    assert len(rows) == 8
    losses = [float(row["training_loss"]) for row in rows]
    assert losses[-1] < losses[0]
    image = np.random.default_rng(0).integers(0, 256, (40, 56, 3), np.uint8)
    torch_map = DeepDetect(unbroken / "best.safetensors").heatmap(image)
    onnx_map = DeepDetect(unbroken / "deepdetect.onnx", backend="onnxruntime").heatmap(image)
    np.testing.assert_allclose(torch_map, onnx_map, atol=1e-4)


def test_the_best_weights_are_those_of_the_lowest_validation_loss(unbroken: Path) -> None:

    from safetensors import safe_open

    with safe_open(unbroken / "best.safetensors", "pt") as file:
        point = json.loads(file.metadata()["point"])
    rows = list(csv.DictReader((unbroken / "curves.csv").read_text().splitlines()))
    assert point["validation_loss"] == pytest.approx(
        min(float(row["validation_loss"]) for row in rows), rel=1e-5
    )


def test_starting_again_after_the_end_changes_nothing(photographs: Path, unbroken: Path) -> None:
    before = (unbroken / "checkpoint.safetensors").read_bytes()
    done = subprocess.run(
        command(photographs, unbroken, unbroken.parent / "labels"),
        check=True,
        capture_output=True,
        text=True,
    )
    assert '"validation_loss"' in done.stdout
    assert (unbroken / "checkpoint.safetensors").read_bytes() == before


def test_where_weights_come_from_is_written_into_them(unbroken: Path) -> None:

    from safetensors import safe_open

    with safe_open(unbroken / "best.safetensors", "pt") as file:
        notes = file.metadata()
    assert notes["command"].startswith("deepdetect train")
    assert "torch 2." in notes["versions"]
    assert len(notes["photographs_digest"]) == 16
    assert json.loads(notes["options"])["seed"] == 0
    state = read_checkpoint(unbroken / "checkpoint.safetensors").state
    assert {"command", "commit", "versions", "machine", "photographs"} <= state.keys()


def test_the_model_card_tells_it_too(unbroken: Path) -> None:
    from safetensors import safe_open

    with safe_open(unbroken / "best.safetensors", "pt") as file:
        notes = file.metadata()
    card = (unbroken / "MODEL_CARD.md").read_text()
    for name in ("command", "commit", "versions", "photographs_digest", "start"):
        assert notes[name] in card
    rows = (unbroken / "curves.csv").read_text().splitlines()
    assert card.count("\n| ") > len(rows), "options and losses are tables"
    assert "short_sides | [96, 64]" in card


def test_own_photographs_and_settings_from_the_shipped_weights(
    photographs: Path, tmp_path: Path
) -> None:
    """The command of docs/fine-tuning.md, on few photographs."""
    settings = tmp_path / "labels.toml"
    settings.write_text('detectors = ["fast", "sobel"]\n[fast]\nnormal = { threshold = 30 }\n')
    arguments = [sys.executable, "-m", "deepdetect", "train", str(photographs), "-o"]
    arguments += [str(tmp_path / "run"), "--init", "default", "--label-settings", str(settings)]
    arguments += ["--stage", "96x4x12", "--short-side", "96", "--learning-rate", "0.0005"]
    arguments += ["--warm-up", "5", "--dark-fraction", "0"]
    arguments += [
        "--val-count",
        "3",
        "--no-compile",
        "--workers",
        "1",
        "--threads",
        "1",
        "--json",
    ]
    subprocess.run(arguments, check=True, capture_output=True)
    rows = list(csv.DictReader((tmp_path / "run" / "curves.csv").read_text().splitlines()))
    losses = [float(row["normal_loss"]) for row in rows]
    assert losses[-1] < losses[0], "it learns the new labels"
    image = photographs / "photo00.png"
    tuned = DeepDetect(tmp_path / "run" / "deepdetect.onnx").detect(image)
    assert 0 < len(tuned) < len(DeepDetect().detect(image)), "fewer corners are wanted"


def test_frozen_batch_norm_keeps_the_statistics_and_trains_the_rest(
    photographs: Path, tmp_path: Path
) -> None:
    arguments = [*command(photographs, tmp_path / "run", tmp_path / "labels")]
    arguments += ["--init", "default"]
    subprocess.run(arguments, check=True, capture_output=True)
    before = load_network(pretrained_weights("default", ".safetensors")).state_dict()
    after = load_network(tmp_path / "run" / "best.safetensors").state_dict()
    kept = {name for name in before if torch.equal(before[name], after[name])}
    statistics = {name for name in before if name.rpartition(".")[2].startswith(("running", "num"))}
    assert kept == statistics
    again = subprocess.run([*arguments, "--batch-norm"], capture_output=True, text=True)
    assert again.returncode == 2, "another recipe, which the folder's run does not have"
    assert "frozen_batch_norm" in again.stderr


@pytest.mark.parametrize("batch_norm", ["--frozen-batch-norm", "--batch-norm"])
def test_only_the_decoder_may_be_trained(
    photographs: Path, tmp_path: Path, batch_norm: str
) -> None:
    arguments = [*command(photographs, tmp_path / "run", tmp_path / "labels"), batch_norm]
    arguments += ["--init", "default", "--freeze-encoder", "--optimizer", "soap"]
    subprocess.run(arguments, check=True, capture_output=True)
    before = load_network(pretrained_weights("default", ".safetensors")).state_dict()
    after = load_network(tmp_path / "run" / "best.safetensors").state_dict()
    kept = {name for name in before if torch.equal(before[name], after[name])}
    encoder = {name for name in before if name.startswith("encoder.")}
    assert encoder <= kept
    decoder = {name for name in before if name.endswith("weight")} - encoder
    assert len(decoder) > 10
    assert not decoder & kept
    subprocess.run(arguments, check=True, capture_output=True)  # its checkpoint is read


def test_training_the_decoder_alone_needs_trained_weights(
    photographs: Path, tmp_path: Path
) -> None:
    arguments = command(photographs, tmp_path / "run", tmp_path / "labels")
    done = subprocess.run([*arguments, "--freeze-encoder"], capture_output=True, text=True)
    assert done.returncode == 2
    assert "--init" in done.stderr
    assert "Traceback" not in done.stderr


def test_frozen_batch_norm_needs_trained_weights(photographs: Path, tmp_path: Path) -> None:
    arguments = command(photographs, tmp_path / "run", tmp_path / "labels")
    done = subprocess.run([*arguments, "--frozen-batch-norm"], capture_output=True, text=True)
    assert done.returncode == 2
    assert "--init" in done.stderr
    assert "Traceback" not in done.stderr


def test_other_options_are_refused_in_the_same_folder(photographs: Path, unbroken: Path) -> None:
    changed = [*command(photographs, unbroken, unbroken.parent / "labels"), "--seed", "5"]
    done = subprocess.run(changed, capture_output=True, text=True)
    assert done.returncode == 2
    assert "seed" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_run_can_start_from_trained_weights(
    photographs: Path, unbroken: Path, tmp_path: Path
) -> None:
    from safetensors import safe_open

    options = TrainingOptions(
        stages=(Stage(64, 4, 1),), short_sides=(64,), detectors=("fast",), val_count=1
    )
    start = unbroken / "best.safetensors"
    still = dataclasses.replace(options, learning_rate=0.0, final_learning_rate=0.0)
    for name, recipe in (("still", still), ("moved", options)):
        train(photographs, tmp_path / name, recipe, init_weights=start, device=PLAIN, workers=1)
    before, after = load_file(start), load_file(tmp_path / "still" / "best.safetensors")
    names = dict(ESPNet().named_parameters())
    assert all(torch.equal(before[name], after[name]) for name in names)
    moved = load_file(tmp_path / "moved" / "best.safetensors")
    assert not any(torch.equal(before[name], moved[name]) for name in names)
    with safe_open(tmp_path / "moved" / "best.safetensors", "pt") as file:
        assert file.metadata()["start"] == weights_digest(load_network(start))
    with pytest.raises(OptionError, match="started from other weights"):
        train(photographs, tmp_path / "moved", options, device=PLAIN, workers=1)


def test_a_run_can_start_from_the_mean_of_several_weights(
    unbroken: Path, photographs: Path, tmp_path: Path
) -> None:
    first = unbroken / "best.safetensors"
    other = tmp_path / "other.safetensors"
    changed = load_network(first)
    with torch.no_grad():
        changed.classifier.weight += 2
    save_weights(changed, other, {})
    mean = average_weights([first, other]).state_dict()
    for name, value in load_network(first).state_dict().items():
        expected = value + 1 if name == "classifier.weight" else value
        torch.testing.assert_close(mean[name], expected)
    recipe = TrainingOptions(
        stages=(Stage(64, 4, 1),), short_sides=(64,), detectors=("fast",), val_count=1
    )
    train(
        photographs, tmp_path / "run", recipe, init_weights=[first, other], device=PLAIN, workers=1
    )
    notes = read_notes(tmp_path / "run" / "best.safetensors")
    assert notes["start"] == weights_digest(average_weights([first, other]))


def test_missing_weights_to_start_from_are_refused_before_any_work(
    photographs: Path, tmp_path: Path
) -> None:
    with pytest.raises(WeightsError, match="there is no weights file"):
        train(photographs, tmp_path / "run", init_weights=tmp_path / "none.safetensors")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("content", [b"", b"no checkpoint", b"\x80\x04K\x01."])
def test_a_damaged_checkpoint_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(content)
    with pytest.raises(WeightsError, match="delete it"):
        read_checkpoint(path)


def test_a_checkpoint_of_another_network_is_refused(tmp_path: Path) -> None:
    network, other = ESPNet(), ESPNet(p=2)
    path = tmp_path / "c.safetensors"
    save_checkpoint(path, other, [torch.optim.Adam(other.parameters())], {})
    with pytest.raises(WeightsError, match="delete it"):
        restore(read_checkpoint(path), path, network, [torch.optim.Adam(network.parameters())])


def test_checkpoints_hold_everything_and_stay_small(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = ESPNet()
    optimizer = torch.optim.Adam(network.parameters(), fused=True)
    network(torch.rand(2, 3, 32, 32)).mean().backward()
    optimizer.step()
    path = tmp_path / "c.safetensors"
    save_checkpoint(path, network, [optimizer], {"step": 1})
    assert path.stat().st_size < 10_000_000

    other = ESPNet()
    other_optimizer = torch.optim.Adam(other.parameters(), fused=True)
    found = read_checkpoint(path)
    assert found.state == {"step": 1}
    restore(found, path, other, [other_optimizer])
    for a, b in zip(network.parameters(), other.parameters(), strict=True):
        assert torch.equal(a, b)
        for moment in ("step", "exp_avg", "exp_avg_sq"):
            assert torch.equal(optimizer.state[a][moment], other_optimizer.state[b][moment])


def gradients(engine: Engine, images: torch.Tensor, truth: torch.Tensor) -> list[torch.Tensor]:
    engine.network.train()
    engine.network.zero_grad()
    loss = torch.nn.functional.binary_cross_entropy_with_logits(engine.logits(images), truth)
    engine.backward(loss)
    return [parameter.grad.clone() for parameter in engine.network.parameters()]


def test_gradients_in_bfloat16_are_those_of_float32_within_rounding() -> None:
    torch.manual_seed(0)
    first, second = ESPNet(), ESPNet()
    second.load_state_dict(first.state_dict())
    rgb = torch.randint(0, 256, (4, 240, 240, 3), dtype=torch.uint8)
    truth = (torch.rand(4, 1, 240, 240) < 0.4).float()
    exact = Engine(first, DeviceOptions("cpu", "float32", compile=False))
    rounded = Engine(second, DeviceOptions("cpu", "bfloat16", compile=False))
    expected = gradients(exact, exact.images(rgb), truth)
    found = gradients(rounded, rounded.images(rgb), truth)
    for name, gradient in zip(dict(first.named_parameters()), found, strict=True):
        assert torch.isfinite(gradient).all(), name
    a = torch.cat([gradient.flatten() for gradient in expected])
    b = torch.cat([gradient.flatten() for gradient in found])
    assert torch.nn.functional.cosine_similarity(a, b, dim=0) > 0.99
    assert (a - b).norm() / a.norm() < 0.1


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
    with pytest.raises(OptionError, match="--no-compile"):
        Engine(ESPNet(), DeviceOptions("cpu", "float32", compile=True)).logits(images)


@pytest.mark.parametrize(
    ("bad", "hint"),
    [({"device": "cpuu"}, "cpu"), ({"precision": "float16"}, "bfloat16"), ({"threads": 0}, "1")],
)
def test_bad_device_options_are_refused(bad: dict, hint: str) -> None:
    with pytest.raises(OptionError, match=hint):
        DeviceOptions(**bad)


def test_a_photograph_that_cannot_be_read_is_named(photographs: Path, tmp_path: Path) -> None:

    folder = tmp_path / "photos"
    shutil.copytree(photographs, folder)
    (folder / "broken.jpg").write_bytes(b"no photograph")
    options = TrainingOptions(
        stages=(Stage(64, 2, 1),), short_sides=(64,), detectors=("fast",), val_count=1
    )
    with pytest.raises(Exception, match=r"broken\.jpg") as caught:
        train(folder, tmp_path / "run", options, device=PLAIN, workers=1)
    assert type(caught.value).__name__ == "DeepDetectError"
    assert len(list((tmp_path / "run" / "labels").rglob("*.png"))) > 10, "the others are kept"


@pytest.mark.parametrize("make", [lambda path: None, lambda path: path.mkdir()])
def test_a_missing_or_empty_folder_is_refused(tmp_path: Path, make) -> None:
    make(tmp_path / "photos")
    with pytest.raises(ImageError):
        train(tmp_path / "photos", tmp_path / "run", device=PLAIN)


def test_one_seed_gives_one_result(photographs: Path, tmp_path: Path) -> None:
    options = TrainingOptions(
        stages=(Stage(64, 4, 1),), short_sides=(64,), detectors=("fast",), val_count=1
    )
    for name in ("a", "b"):
        train(photographs, tmp_path / name, options, labels=tmp_path / "l", device=PLAIN, workers=1)
    assert tensors_equal(tmp_path / "a" / "best.safetensors", tmp_path / "b" / "best.safetensors")


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
        gradients(eager, eager.images(rgb), truth),
        gradients(compiled, compiled.images(rgb), truth),
        strict=True,
    ):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-3)
