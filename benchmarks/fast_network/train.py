"""Train `FastNetwork` for some CPU seconds, on views that `views.py` makes at the same time.

    python benchmarks/fast_network/train.py VIEWS OUTPUT SECONDS [--init WEIGHTS] [--rate 0.002]

The recipe is that of `deepdetect train` without files of labels: SOAP, bfloat16, batches of 16
views of 480x480 pixels or of about as many pixels in other sizes, and a learning rate that falls
by one cosine. The written weights are an exponential moving average. The script prints steps, seen
pixels in units of 480x480, CPU seconds, learning rate, loss, BCE and IoU over every fourth
validation photograph in normal light and darkened, and the number of views made so far.

The weights `default` come from two runs on 2,705 photographs (29,703 views). The first run took
5,400 s of one thread (AMD EPYC with bfloat16, shared with other work). It began with the weights of
the previous network, fitted to the new form by least squares. That network had a convolution at a
quarter of the image size in place of the one at half of it; it was trained from random weights
(60c01c10, 465 s on a third of an NVIDIA H100). The second run took 2,400 s and began with the first
one, with a rate of 0.0014 and seed 4. `dense` also began with the first run: 1,800 s, labels
`dense`, rate 0.0015. `free` is one run of 2,000 s from random weights. In these runs the first
kernels were trained as 3x3 of the four pixels of each 2x2, which is equivalent, and the thresholds
had the opposite sign. For scores see `docs/results/validation.csv` and `label-prediction.csv`.
"""

from __future__ import annotations

import argparse
import copy
import math
import time
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits as bce

from deepdetect_lab.networks.fast import FastNetwork
from deepdetect_lab.training.optim import Soap

BATCHES = {"S": 64, "T": 30, "M": 16, "L": 4}
SHARES = {"S": 0.14, "T": 0.12, "M": 0.62, "L": 0.12}
"""Batch size, and share of the batches, for each size of views. Chosen by hand."""

KINDS = np.array([0.26, 0.20, 0.32, 0.22])
"""Shares of views that are unchanged, darkened, augmented, and both darkened and augmented. Kinds
without views are left out. Chosen by hand."""

WARM_UP, DECAY = 0.04, 0.999
"""Fraction of the training over which the rate rises, and decay of the average of the weights in
each step. Chosen by hand."""

BIAS = 0.1
"""This number is added to the logits at the end. Calibrated weights mark fewer pixels than the
labels do; with the bias they mark more at the same loss. On every second photograph of photos/val
the loss is 0.0851 in normal light and 0.1121 darkened (without bias 0.0851 and 0.1120), and the
densities are 0.296 and 0.203 (0.294 and 0.199; labels 0.300 and 0.214)."""


class Views:
    """The views made so far, in memory."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.seen, self.count = folder, set[str](), 0
        self.views: dict[str, list[list[np.ndarray]]] = {size: [[], [], [], []] for size in BATCHES}

    def take(self) -> None:
        """Load new chunks."""
        for path in self.folder.glob("[STML][0-3]-*.npy"):
            if path.name not in self.seen:
                views = list(np.load(path))
                self.views[path.name[0]][int(path.name[1])] += views
                self.seen.add(path.name)
                self.count += len(views)

    def batch(self, rng: np.random.Generator) -> Tensor:
        """Return (N, 2, S, S) uint8 views of one random size, transposed in half of the cases."""
        size = str(rng.choice(list(SHARES), p=list(SHARES.values())))
        of_size = self.views[size]
        shares = KINDS * [len(views) > 0 for views in of_size]
        kinds = rng.choice(4, BATCHES[size], p=shares / shares.sum())
        chosen = [of_size[kind][rng.integers(len(of_size[kind]))] for kind in kinds]
        batch = torch.from_numpy(np.stack(chosen))
        return batch.transpose(2, 3).contiguous() if rng.random() < 0.5 else batch

    def validation(self) -> list[Tensor]:
        """Return the views of the validation photographs, in normal light and darkened."""
        lights = [sorted(self.folder.glob(f"val{light}-*.npy")) for light in range(2)]
        parts = [[np.load(path) for path in paths] for paths in lights if paths]
        return [torch.from_numpy(np.concatenate(each)) for each in parts]


def images(views: Tensor) -> Tensor:
    """Return grey (B, 3, H, W) RGB images in [0, 1] with the luma of the views."""
    return (views[:, :1].float() / 255).expand(-1, 3, -1, -1)


@torch.no_grad()
def scores(network: nn.Module, lights: list[Tensor]) -> list[float]:
    """Return BCE and IoU for each light, as means over every fourth photograph."""
    result = []
    for light in lights:
        losses, overlaps = [], []
        for part in light[::4].split(8):
            logits, label = network(images(part)), part[:, 1:].float()
            losses += bce(logits, label, reduction="none").mean((1, 2, 3)).tolist()
            marked, true = logits > 0, label > 0
            both, either = (marked & true).sum((1, 2, 3)), (marked | true).sum((1, 2, 3))
            overlaps += (both / either.clamp(min=1)).tolist()
        result += [float(np.mean(losses)), float(np.mean(overlaps))]
    return result


def learning_rate(highest: float, progress: float) -> float:
    """Return the learning rate at a fraction of the training."""
    if progress < WARM_UP:
        return highest * progress / WARM_UP
    cosine = math.cos(math.pi * (progress - WARM_UP) / (1 - WARM_UP))
    return highest * max((1 + cosine) / 2, 1e-3)


def main() -> None:
    """Train and write the weights."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("views", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("seconds", type=float)
    parser.add_argument("--init", type=Path)
    parser.add_argument("--rate", type=float, default=2e-3)
    parser.add_argument("--seed", type=int, default=3)
    given = parser.parse_args()
    torch.manual_seed(given.seed)
    views, rng = Views(given.views), np.random.default_rng(given.seed)
    views.take()
    network = FastNetwork().to(memory_format=torch.channels_last)
    if given.init:
        network.load_state_dict(load_file(given.init))
    average = copy.deepcopy(network).eval()
    network.train()
    kernels = [p for p in network.parameters() if p.ndim > 1]
    vectors = [p for p in network.parameters() if p.ndim <= 1]
    optimizers = [Soap(kernels), torch.optim.Adam(vectors, fused=True)]
    states = [
        [value for value in each.state_dict().values() if value.is_floating_point()]
        for each in (average, network)
    ]
    begun, step, seen, shown, taken, losses = time.process_time(), 0, 0.0, 0.0, time.time(), []
    while (progress := (time.process_time() - begun) / given.seconds) < 1:
        batch = views.batch(rng)
        with torch.autocast("cpu", torch.bfloat16):
            logits = network(images(batch))
        loss = bce(logits.float(), batch[:, 1:].float())
        for optimizer in optimizers:
            optimizer.zero_grad(set_to_none=True)
            for group in optimizer.param_groups:
                group["lr"] = learning_rate(given.rate, progress)
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        for optimizer in optimizers:
            optimizer.step()
        step, seen = step + 1, seen + len(batch) * batch.shape[-1] ** 2 / 480**2
        losses.append(loss.item())
        with torch.no_grad():
            torch._foreach_lerp_(states[0], states[1], 1 - min(DECAY, 1 - (step + 1) ** -0.8))
        if time.time() - taken > 60:
            views.take()
            taken = time.time()
        if progress > shown + 0.04:
            shown = progress
            numbers = *scores(average, views.validation()), views.count
            seconds, rate = time.process_time() - begun, learning_rate(given.rate, progress)
            print(step, seen, seconds, rate, np.mean(losses), *numbers, sep=",", flush=True)
            losses = []
    average.get_parameter("logits.bias").data += BIAS
    tensors = {name: value.contiguous() for name, value in average.state_dict().items()}
    save_file(tensors, given.output)


if __name__ == "__main__":
    main()
