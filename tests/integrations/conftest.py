"""Two views of a photograph, and what is known of them."""

from __future__ import annotations

import importlib
import importlib.util
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True, eq=False)
class Views:
    """A photograph, the same turned and enlarged, (H, W, 3) uint8 RGB, and the (2, 3) affinity."""

    first: np.ndarray
    second: np.ndarray
    affinity: np.ndarray

    def correct(self, points0: np.ndarray, points1: np.ndarray, within_px: float = 3) -> float:
        """Return the share of matches that the affinity confirms."""
        assert len(points0) == len(points1) > 0
        moved = np.asarray(points0, np.float64) @ self.affinity[:, :2].T + self.affinity[:, 2]
        return float((np.hypot(*(moved - points1).T) < within_px).mean())


@pytest.fixture(scope="session")
def views(photo: np.ndarray) -> Views:
    """Not square, so that swapped axes fail; turned by 30 degrees, enlarged by 1.2."""
    first = np.ascontiguousarray(photo[:200])
    affinity = cv2.getRotationMatrix2D((128, 100), 30, 1.2)
    second = cv2.warpAffine(first, affinity, (256, 200), flags=cv2.INTER_CUBIC)
    return Views(first, second, affinity)


@pytest.fixture(scope="session")
def hub(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folders for model hubs; what transformers makes of their code is kept beside them."""
    pytest.importorskip("hatchling", reason="needs hatchling, which builds the wheel")
    folder = tmp_path_factory.mktemp("hub")
    subprocess.run([sys.executable, ROOT / "tools/hub", folder / "hub"], check=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("transformers.dynamic_module_utils.HF_MODULES_CACHE", str(folder / "modules"))
        yield folder / "hub"


@pytest.fixture
def drop_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[str, dict[str, str]], ModuleType]]:
    """Import a drop-in with its program, or where that is missing with one of the same contract."""
    used: list[str] = []

    def take(package: str, files: dict[str, str]) -> ModuleType:
        if importlib.util.find_spec(package) is None:
            for name, text in files.items():
                path = tmp_path / "stand-ins" / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text)
            monkeypatch.syspath_prepend(tmp_path / "stand-ins")
            used.append(package)
        return importlib.import_module(f"deepdetect.integrations.{package}")

    yield take
    for package in used:
        for name in list(sys.modules):
            if f"{name}.".startswith((f"{package}.", f"deepdetect.integrations.{package}.")):
                del sys.modules[name]
