"""Commands that are killed at any time: what they leave, and whether they go on."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from tqdm import tqdm

from .targets.images import scene

KILL_COLUMNS = ("killed", "had ended", "unreadable", "rerun differs", "left over")
LIMIT_S = 600.0


@dataclass(frozen=True)
class Command:
    """A command over a folder of images.

    Attributes:
        words: its arguments; IN and OUT stand for the folders, FEATURES and PAIRS for files.
        compared: patterns of files that must be the same after a rerun; others hold times.
    """

    words: Sequence[str]
    compared: Sequence[str]


COMMANDS = {
    "label": Command(("label", "IN", "-o", "OUT", "--workers", "2"), ("*.png",)),
    "detect": Command(("detect", "IN", "-o", "OUT"), ("*.npz", "*.png")),
    "extract": Command(
        ("extract", "IN", "-o", "OUT/features.h5", "--workers", "2", "--max-keypoints", "500"),
        ("*.h5",),
    ),
    "match-many": Command(
        ("match-many", "FEATURES", "--pairs", "PAIRS", "-o", "OUT/matches.h5", "--workers", "2"),
        ("*.h5",),
    ),
    "train": Command(
        (
            *("train", "IN", "-o", "OUT", "--stage", "64x4x2", "--short-side", "96"),
            *("--detectors", "fast", "--val-count", "2", "--device", "cpu", "--no-compile"),
            *("--precision", "float32", "--threads", "1", "--workers", "1"),
        ),
        ("*.onnx",),
    ),
    "benchmark": Command(
        (
            *("dev", "benchmark", "foreground", "--data", "DATA", "-o", "OUT"),
            *("--baselines", "fast,harris,sift,orb"),
        ),
        ("tables/*.csv",),
    ),
}


def run_kills(count: int, *, seed: int) -> dict[str, dict[str, int]]:
    """Kill each command equally often, at random times, and run it again.

    Args:
        count: of all kills.
        seed: of the times.

    Returns:
        For each command how many were killed and how many had ended before, how many files under
        a final name could not be read, after how many reruns results were not those of an
        unbroken run, and how many hidden files were left over after the rerun.
    """
    generator = np.random.default_rng(seed)
    found = {}
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        inputs = write_inputs(root)
        for name, command in COMMANDS.items():
            words = [inputs.get(word, word) for word in command.words]
            begin = time.monotonic()
            unbroken = root / f"{name}-unbroken"
            finish(words, unbroken)
            took = time.monotonic() - begin
            expected = digests(unbroken, command.compared)
            row = dict.fromkeys(KILL_COLUMNS, 0)
            for k in tqdm(range(count // len(COMMANDS)), desc=f"kills of {name}", unit="kill"):
                output = root / f"{name}-{k}"
                ended = kill(words, output, took * generator.uniform(0.1, 1.0))
                row["had ended" if ended else "killed"] += 1
                row["unreadable"] += sum(not readable(path) for path in final_files(output))
                finish(words, output)
                row["rerun differs"] += digests(output, command.compared) != expected
                row["left over"] += sum(".part" in path.name for path in output.rglob(".*"))
            found[name] = row
    return found


def write_inputs(root: Path) -> dict[str, str]:
    """Write what the commands work on; return the paths, by the words that stand for them."""
    images, features, pairs = write_images(root), root / "features.h5", root / "pairs.txt"
    finish(("extract", str(images), "-o", str(features), "--max-keypoints", "500"), root)
    names = sorted(path.name for path in images.iterdir())
    pairs.write_text("".join(f"{a} {b}\n" for a, b in itertools.combinations(names, 2)))
    paths = {"IN": images, "DATA": root, "FEATURES": features, "PAIRS": pairs}
    return {word: str(path) for word, path in paths.items()}


def write_images(root: Path) -> Path:
    """Write the photographs that the commands work on, with masks for the benchmark."""
    images, masked = root / "images", root / "foreground"
    images.mkdir()
    masked.mkdir()
    for k in range(12):
        picture = np.roll(np.tile(scene(), (3, 3, 1)), 7 * k, axis=1)
        Image.fromarray(picture).save(images / f"{k:02d}.png")
        if k < 3:
            Image.fromarray(picture).save(masked / f"{k}.png")
            mask = np.zeros(picture.shape[:2], np.uint8)
            mask[40:90, 30:100] = 255
            Image.fromarray(mask).save(masked / f"{k}_mask.png")
    return images


def start(words: Sequence[str], output: Path) -> subprocess.Popen[bytes]:
    """Start a command in a process group of its own."""
    line = [sys.executable, "-m", "deepdetect", *words]
    return subprocess.Popen(
        [re.sub("^OUT(?=$|/)", str(output), word) for word in line],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def finish(words: Sequence[str], output: Path) -> None:
    """Run a command to its end.

    Raises:
        RuntimeError: it fails.
    """
    process = start(words, output)
    _, errors = process.communicate(timeout=LIMIT_S)
    if process.returncode:
        raise RuntimeError(f"{' '.join(words)} failed: {errors.decode()[-2000:]}")


def kill(words: Sequence[str], output: Path, after_s: float) -> bool:
    """Kill a command and all its processes after some seconds; return whether it had ended."""
    process = start(words, output)
    try:
        process.communicate(timeout=after_s)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return False
    return True


def final_files(output: Path) -> list[Path]:
    """Return the files under final names: those that are not hidden."""
    if not output.exists():
        return []
    return [
        path
        for path in output.rglob("*")
        if path.is_file()
        and not any(part.startswith(".") for part in path.relative_to(output).parts)
    ]


def readable(path: Path) -> bool:
    """Whether a file is whole, as far as its kind lets one see."""
    try:
        if path.suffix in (".png", ".jpg"):
            with Image.open(path) as image:
                image.load()
        elif path.suffix == ".npz":
            with np.load(path) as arrays:
                for name in arrays:
                    _ = arrays[name]
        elif path.suffix == ".h5":
            contents(path)
        elif path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".safetensors":
            from safetensors.numpy import load_file

            load_file(path)
        elif path.suffix == ".onnx":
            import onnxruntime

            onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
        elif path.suffix in (".csv", ".md"):
            return path.stat().st_size > 0
    except Exception:
        return False
    return True


def contents(path: Path) -> bytes:
    """Return the numbers of an HDF5 file; its bytes depend on the order in which it was filled."""
    import h5py

    found: list[bytes] = []

    def note(name: str, member: Any) -> None:
        if isinstance(member, h5py.Dataset):
            found.append(f"{name} {member.dtype} {member.shape}".encode() + member[()].tobytes())

    with h5py.File(path) as file:
        file.visititems(note)
    return b"".join(sorted(found))


def digests(output: Path, patterns: Sequence[str]) -> dict[str, str]:
    """Return the digests of the files that a rerun must give again."""
    return {
        path.relative_to(output).as_posix(): hashlib.sha256(
            contents(path) if path.suffix == ".h5" else path.read_bytes()
        ).hexdigest()
        for pattern in patterns
        for path in sorted(output.rglob(pattern) if "/" not in pattern else output.glob(pattern))
    }
