"""Train the fast network on the views that `views.py` makes meanwhile, for a number of seconds.

    python train.py VIEWS OUTPUT SECONDS [--init WEIGHTS] [--learning-rate 0.004]

AdamW, batches of 32 views of 480 pixels or as many pixels of others, one cosine; the weights are an
exponential average. `h100.safetensors` are those of 465 s of a third of an NVIDIA H100, by an
earlier form of this script, on the 2,705 photographs of photos/train: 10,929 steps from random
numbers at a rate of .004, 349,728 images' worth of 480x480. `h100.csv` has step, images, seconds,
rate, loss, BCE and IoU of every fourth photograph of photos/val in normal light and darkened, views
made so far, and the scale of float16. On all of photos/val they have .0888 / .885 and .1102 / .770.
Two other networks were trained beside it and lost there, one with two gains (.0928 / .873 and
.1162 / .762), one that halves the size once more (.0976 / .864 and .1170 / .761).
"""

from __future__ import annotations

import argparse
import copy
import math
import threading
import time
from pathlib import Path

import numpy as np
import torch
from network import FastNetwork
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits as bce

SIDES_PX = {"S": 240, "M": 480, "L": 960}
KEPT = {"S": 7000, "M": 14000, "L": 1166}
"""Views on the device; newer ones replace the oldest."""

BATCHES = {"S": 128, "M": 32, "L": 8}
SHARES = {"S": 0.15, "M": 0.70, "L": 0.15}
KINDS = np.array([0.30, 0.20, 0.30, 0.20])
"""Shares of: as it is, darkened, augmented, augmented and darkened."""

WARM_UP = 0.05
"""Of the training, in which the learning rate rises."""

DECAY = 0.999
"""Of the average of the weights."""


class Views:
    """The views that were made last, on the device."""

    def __init__(self, folder: Path, device: str) -> None:
        self.folder, self.device = folder, device
        self.pool = {
            size: torch.empty((KEPT[size], 2, side, side), dtype=torch.uint8, device=device)
            for size, side in SIDES_PX.items()
        }
        self.kinds = {size: np.full(kept, -1) for size, kept in KEPT.items()}
        self.count = dict.fromkeys(SIDES_PX, 0)
        self.seen: set[str] = set()

    def take(self) -> int:
        """Load chunks that are new; return how many."""
        new = [p for p in self.folder.glob("[SML][0-3]-*.npy") if p.name not in self.seen]
        for path in new:
            size, views = path.name[0], torch.from_numpy(np.load(path))
            start = self.count[size] % KEPT[size]
            views = views[: KEPT[size] - start]
            self.pool[size][start : start + len(views)] = views.to(self.device)
            self.kinds[size][start : start + len(views)] = int(path.name[1])
            self.count[size] += len(views)
            self.seen.add(path.name)
        return len(new)

    def take_for_ever(self) -> None:
        """Run beside the training."""
        while True:
            if not self.take():
                time.sleep(0.5)

    def batch(self, rng: np.random.Generator) -> Tensor:
        """Return (N, 2, S, S) uint8 of one size, half of the times transposed."""
        size = str(rng.choice(list(SHARES), p=list(SHARES.values())))
        by_kind = [np.flatnonzero(self.kinds[size] == kind) for kind in range(4)]
        shares = KINDS * [len(views) > 0 for views in by_kind]
        kinds = rng.choice(4, BATCHES[size], p=shares / shares.sum())
        chosen = np.array([rng.choice(by_kind[kind]) for kind in kinds])
        views = self.pool[size][torch.from_numpy(chosen).to(self.device)]
        return views.transpose(2, 3) if rng.random() < 0.5 else views

    def validation(self) -> list[Tensor]:
        """Return the views of the validation photographs, in normal light and darkened."""
        lights = [sorted(self.folder.glob(f"val{light}-*.npy")) for light in range(2)]
        return [torch.from_numpy(np.concatenate([np.load(p) for p in paths])) for paths in lights]


@torch.no_grad()
def scores(network: nn.Module, views: list[Tensor], device: str) -> list[float]:
    """Return BCE and IoU, means over photographs, of each light."""
    result = []
    for light in views:
        losses, overlaps = [], []
        for part in light.split(16):
            part = part.to(device)
            logits, label = network(part[:, :1] / 255), part[:, 1:].float()
            losses += bce(logits, label, reduction="none").mean((1, 2, 3)).tolist()
            marked, true = logits > 0, label > 0
            both, either = (marked & true).sum((1, 2, 3)), (marked | true).sum((1, 2, 3))
            overlaps += (both / either.clamp(min=1)).tolist()
        result += [float(np.mean(losses)), float(np.mean(overlaps))]
    return result


def learning_rate(highest: float, progress: float) -> float:
    """Return the rate at a share of the training."""
    if progress < WARM_UP:
        return highest * progress / WARM_UP
    cosine = math.cos(math.pi * (progress - WARM_UP) / (1 - WARM_UP))
    return highest * max((1 + cosine) / 2, 1e-3)


def save(network: nn.Module, path: Path) -> None:
    """Write the weights."""
    save_file({name: each.contiguous() for name, each in network.state_dict().items()}, path)


def main() -> None:
    """Train and write the weights."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("views", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("seconds", type=float)
    parser.add_argument("--init", type=Path)
    parser.add_argument("--learning-rate", type=float, default=4e-3)
    given = parser.parse_args()
    device = "cuda" if torch.cuda.is_available() else "cpu"
    half = torch.float16 if device == "cuda" else torch.bfloat16
    torch.manual_seed(3)
    torch.backends.cudnn.benchmark = True
    views, rng = Views(given.views, device), np.random.default_rng(3)
    while min(views.count.values()) < 2:
        time.sleep(0.5)
        views.take()
    threading.Thread(target=views.take_for_ever, daemon=True).start()
    network = FastNetwork().to(device, memory_format=torch.channels_last)
    if given.init:
        network.load_state_dict(load_file(given.init, device))
    average = copy.deepcopy(network).eval()
    kernels = [p for p in network.parameters() if p.ndim > 1]
    vectors = [p for p in network.parameters() if p.ndim <= 1]
    groups = [
        {"params": kernels, "weight_decay": 1e-2},
        {"params": vectors, "weight_decay": 0.0},
    ]
    optimizer = torch.optim.AdamW(groups, betas=(0.9, 0.98), fused=device == "cuda")
    scaler = torch.amp.GradScaler(device, enabled=device == "cuda")
    states = [
        [value for value in each.state_dict().values() if value.is_floating_point()]
        for each in (average, network)
    ]
    begun, step, shown = time.time(), 0, 0.0
    while (progress := (time.time() - begun) / given.seconds) < 1:
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(given.learning_rate, progress)
        batch = views.batch(rng)
        with torch.autocast(device, half):
            logits = network(batch[:, :1] / 255)
        loss = bce(logits.float(), batch[:, 1:].float())
        optimizer.zero_grad(set_to_none=True)
        scaler.scale(loss).backward()
        scaler.unscale_(optimizer)
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        scaler.step(optimizer)
        scaler.update()
        step += 1
        with torch.no_grad():
            decay = min(DECAY, 1 - (step + 1) ** -0.8)
            torch._foreach_lerp_(states[0], states[1], 1 - decay)
        if progress > shown + 0.05:
            shown = progress
            save(average, given.output)
            print(step, loss.item(), *scores(average, views.validation(), device), flush=True)
    save(average, given.output)
    print(step, *scores(average, views.validation(), device))


if __name__ == "__main__":
    main()
