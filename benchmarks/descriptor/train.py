"""Train the learned descriptor on pairs that `views.py` draws meanwhile, and write it as ONNX.

    python benchmarks/descriptor/train.py PHOTOS VALIDATION OUTPUT STEPS [--init OUTPUT]

PHOTOS and VALIDATION are folders of square images of one size. Eight pairs of views of 256 pixels
with up to 256 keypoints are a batch; each keypoint must find its own among those of the other view
(cross-entropy in both directions, others nearer than 5 px left out). Where a pair is turned, its
descriptors are turned back by the true angle with noise, as detectors measure it. Muon for kernels,
AdamW for vectors; a constant rate, a linear decay over the last steps, exponential averages. One
batch of four is new, the others are drawn again from the last 500. OUTPUT.safetensors holds the
averages, OUTPUT.onnx what the package reads; `--init` goes on from one. It prints steps, CPU
seconds, rate, loss, and of 96 pairs of VALIDATION the share of keypoints that are matched and right
(mutual nearest neighbours, 3 px), in upright pairs and in turned ones.
"""

from __future__ import annotations

import argparse
import copy
import math
import multiprocessing
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from network import DescriptorNetwork, turn
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn.functional import cross_entropy
from views import Pair, draw_pair

from deepdetect.io.image import load_image, luma

PAIRS, KEPT_BATCHES, REUSE = 8, 500, 4
RATE, VECTOR_RATE, WARM_UP, DECAY_SHARE = 0.012, 0.0048, 150, 0.3
EMA, MAX_LOG_TEMPERATURE = 0.998, 4.3
NEAR_PX, UPRIGHT, ANGLE_NOISE = 5.0, 0.45, 0.15
MEASURE_EVERY = 100


class Muon(torch.optim.Optimizer):
    """Muon: momentum whose matrix is made orthogonal by Newton-Schulz iterations."""

    def __init__(self, parameters: list[nn.Parameter]) -> None:
        super().__init__(parameters, {"lr": RATE})

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]  # takes no closure
        """Make one step along the gradients of the parameters."""
        for group in self.param_groups:
            for parameter in group["params"]:
                gradient = parameter.grad.reshape(len(parameter), -1)
                mean = self.state[parameter].setdefault("mean", torch.zeros_like(gradient))
                mean.lerp_(gradient, 0.05)
                update = gradient.lerp(mean, 0.95)
                tall = update.shape[0] > update.shape[1]
                x = (update.T if tall else update) / (update.norm() + 1e-7)
                x = x.bfloat16()
                for _ in range(5):
                    product = x @ x.T
                    x = 3.4445 * x + (2.0315 * product @ product - 4.775 * product) @ x
                x = (x.T if tall else x).float().reshape(parameter.shape)
                scale = 0.2 * math.sqrt(max(update.shape))
                parameter.mul_(1 - 0.01 * group["lr"]).add_(x, alpha=-group["lr"] * scale)


def photographs(folder: Path) -> np.ndarray:
    """Return the (N, H, W) luma of a folder's images."""
    return np.stack([luma(load_image(path)) for path in sorted(folder.iterdir())])


def draw_batch(rng: np.random.Generator, images: np.ndarray) -> list[np.ndarray]:
    """Draw pairs that share enough, each field of `Pair` stacked."""
    pairs: list[Pair] = []
    while len(pairs) < PAIRS:
        if (pair := draw_pair(rng, images)) is not None:
            pairs.append(pair)
    return [np.stack(field) for field in zip(*pairs, strict=True)]


def draw_for_ever(queue: Any, folder: Path, seed: int) -> None:
    """Fill a queue with batches."""
    cv2_threads_off()
    images, rng = photographs(folder), np.random.default_rng(seed)
    while True:
        queue.put(draw_batch(rng, images))


def cv2_threads_off() -> None:
    """Leave the other processors to the training."""
    import cv2

    cv2.setNumThreads(1)


def batches(queue: Any, rng: np.random.Generator) -> Iterator[Pair]:
    """Yield new batches and, in between, old ones."""
    kept: list[list[np.ndarray]] = []
    while True:
        for number in range(REUSE):
            if number == 0 or len(kept) < 20:
                kept = [*kept[-KEPT_BATCHES:], queue.get()]
                batch = kept[-1]
            else:
                batch = kept[int(rng.integers(len(kept)))]
            yield Pair(*(torch.from_numpy(field) for field in batch))  # type: ignore[arg-type]


def described(network: DescriptorNetwork, batch: Any) -> tuple[Tensor, Tensor]:
    """Return the upright descriptors of both views, (B, N, 64) each."""
    images = torch.cat([batch.images[:, 0], batch.images[:, 1]])[:, None].float() / 255
    with torch.autocast("cpu", torch.bfloat16):
        maps = network.maps(images.contiguous(memory_format=torch.channels_last))
    size = torch.tensor([images.shape[3], images.shape[2]], dtype=torch.float32)
    positions = torch.cat([batch.positions0, batch.positions1])
    sizes = torch.cat([batch.sizes0, batch.sizes1])
    first, second = network.describe(maps, positions, sizes, size).chunk(2)
    return first, second


def loss_of(network: DescriptorNetwork, batch: Any, rng: np.random.Generator) -> Tensor:
    """Return the cross-entropy of the right keypoint among all of the other view."""
    first, second = described(network, batch)
    # Of pairs that are hardly turned half are compared as they are, as upright images will be.
    as_is = (batch.turn < UPRIGHT) & torch.from_numpy(rng.random(PAIRS) < 0.5)
    noise = torch.from_numpy(rng.normal(0, ANGLE_NOISE, batch.turns.shape)).float()
    back = torch.where(as_is[:, None], torch.zeros(()), -(batch.turns + noise))
    scale = network.temp.clamp(max=MAX_LOG_TEMPERATURE).exp()
    similar = first @ turn(second, back).transpose(1, 2) * scale
    near = _near(batch.positions0) | _near(batch.positions1)
    left_out = near & ~torch.eye(near.shape[1], dtype=torch.bool)
    valid = batch.valid
    forth = similar.masked_fill(left_out | ~valid[:, None], -1e4)
    back_again = similar.masked_fill(left_out | ~valid[:, :, None], -1e4).transpose(1, 2)
    own = torch.arange(valid.shape[1]).expand(valid.shape)[valid]
    return (cross_entropy(forth[valid], own) + cross_entropy(back_again[valid], own)) / 2


def _near(xy: Tensor) -> Tensor:
    return (xy[:, :, None] - xy[:, None]).square().sum(-1) < NEAR_PX**2


@torch.no_grad()
def shares_right(network: DescriptorNetwork, measured: list[Any]) -> tuple[float, float]:
    """Return the shares of keypoints that are matched and right, in upright and turned pairs."""
    shares: tuple[list[float], list[float]] = [], []
    noise = np.random.default_rng(1)
    for batch in measured:
        first, second = described(network, batch)
        shape = batch.turns.shape
        back = -(batch.turns + torch.from_numpy(noise.normal(0, ANGLE_NOISE, shape)).float())
        turned = turn(second, back)
        for row, valid in enumerate(batch.valid):
            is_turned = bool(batch.turn[row] >= UPRIGHT)
            other = (turned if is_turned else second)[row][valid]
            similar = first[row][valid] @ other.T
            nearest = similar.argmax(1)
            mutual = similar.argmax(0)[nearest] == torch.arange(len(nearest))
            places = batch.positions1[row][valid]
            right = (places[nearest] - places).norm(dim=1) < 3
            shares[is_turned].append((mutual & right).float().mean().item())
    return float(np.mean(shares[0])), float(np.mean(shares[1]))


def write(network: DescriptorNetwork, output: Path) -> None:
    """Write the tensors, and the ONNX file."""
    tensors = {name: value.contiguous() for name, value in network.state_dict().items()}
    save_file(tensors, output.with_suffix(".safetensors"))
    inputs = torch.zeros(1, 1, 96, 128), torch.ones(1, 50, 2), torch.ones(1, 50)
    names = ["luma", "xy", "sizes"]
    torch.onnx.export(
        network.eval(),
        inputs,
        str(output.with_suffix(".onnx")),
        input_names=names,
        output_names=["descriptors"],
        opset_version=17,
        dynamo=False,
        dynamic_axes={"luma": {2: "height", 3: "width"}}
        | {name: {1: "keypoints"} for name in ("xy", "sizes", "descriptors")},
    )
    halve(output.with_suffix(".onnx"))


def halve(path: Path) -> None:
    """Store the kernels of an ONNX file as float16; runtimes compute in float32 as before."""
    model = onnx.load(path)
    graph = model.graph
    for kernel in [each for each in graph.initializer if math.prod(each.dims) > 1000]:
        name = f"{kernel.name}_float16"
        values = onnx.numpy_helper.to_array(kernel).astype(np.float16)
        cast = onnx.helper.make_node("Cast", [name], [kernel.name], to=onnx.TensorProto.FLOAT)
        graph.node.insert(0, cast)
        graph.initializer.remove(kernel)
        graph.initializer.append(onnx.numpy_helper.from_array(values, name))
    onnx.save(model, path)


def main() -> None:
    """Train and write the weights."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("photos", type=Path)
    parser.add_argument("validation", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("steps", type=int)
    parser.add_argument("--init", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    torch.manual_seed(given.seed)
    rng, fixed = np.random.default_rng(given.seed), np.random.default_rng(5)
    queue: Any = multiprocessing.Queue(maxsize=12)
    job = queue, given.photos, given.seed
    multiprocessing.Process(target=draw_for_ever, args=job, daemon=True).start()
    validation = photographs(given.validation)
    measured = [
        Pair(*(torch.from_numpy(field) for field in draw_batch(fixed, validation)))  # type: ignore[arg-type]
        for _ in range(12)
    ]
    network = DescriptorNetwork()
    if given.init:
        network.load_state_dict(load_file(given.init.with_suffix(".safetensors")))
    network = network.to(memory_format=torch.channels_last)
    average = copy.deepcopy(network).eval()
    network.train()
    named = list(network.named_parameters())
    kernels = [p for name, p in named if p.ndim > 1 and not name.startswith(("hf", "film"))]
    others = [p for _, p in named if all(p is not kernel for kernel in kernels)]
    optimizers = [
        Muon(kernels),
        torch.optim.AdamW(others, betas=(0.9, 0.98), weight_decay=0, fused=True),
    ]
    states = [
        [value for value in each.state_dict().values() if value.is_floating_point()]
        for each in (average, network)
    ]
    begun, losses = time.process_time(), []
    for step, batch in zip(range(given.steps), batches(queue, rng), strict=False):
        left = (given.steps - step) / (DECAY_SHARE * given.steps)
        rate = min(1, (step + 1) / WARM_UP, left)
        loss = loss_of(network, batch, rng)
        for optimizer, highest in zip(optimizers, (RATE, VECTOR_RATE), strict=True):
            optimizer.zero_grad(set_to_none=True)
            optimizer.param_groups[0]["lr"] = rate * highest
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 2.0)
        for optimizer in optimizers:
            optimizer.step()
        losses.append(loss.item())
        with torch.no_grad():
            decay = min(EMA, 1 - (step + 2) ** -0.8)
            torch._foreach_lerp_(states[0], states[1], 1 - decay)
        if (step + 1) % MEASURE_EVERY == 0 or step + 1 == given.steps:
            seconds, shares = time.process_time() - begun, shares_right(average, measured)
            print(step + 1, seconds, rate * RATE, np.mean(losses), *shares, sep=",", flush=True)
            losses = []
    write(average, given.output)


if __name__ == "__main__":
    main()
