"""What writes weights where no space is left: one sentence, and nothing half-written stays."""

from __future__ import annotations

import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from deepdetect import DeepDetectError
from deepdetect.detector.points.ranker import load_ranker
from deepdetect_lab.networks.espnet import ESPNet
from deepdetect_lab.networks.export import export_onnx
from deepdetect_lab.networks.weights import save_tensors
from deepdetect_lab.training.checkpoint import save_checkpoint
from deepdetect_lab.training.points.task import save_ranker


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """Let writing fail beyond a size, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


WRITERS: dict[str, Callable[[Path], None]] = {
    "best.safetensors": lambda path: save_tensors(ESPNet().state_dict(), path, {}),
    "checkpoint.safetensors": lambda path: save_checkpoint(path, ESPNet(), ESPNet(), [], {}),
    "deepdetect.onnx": lambda path: export_onnx(ESPNet(), path),
    "best.npz": lambda path: save_ranker(load_ranker(), path),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_one_sentence(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"old")
    with files_of_at_most(1024), pytest.raises(DeepDetectError, match=name):
        WRITERS[name](tmp_path / name)
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [(name, b"old")]
