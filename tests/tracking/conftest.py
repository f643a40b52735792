from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from deepdetect.geometry.camera import Camera
from deepdetect.tracking import TrackedFrame, Trajectory

SIZE = (640, 480)


@pytest.fixture(scope="session")
def moving_photo() -> Callable[[int, tuple[int, int]], np.ndarray]:
    """Frame k of a camera that moves over a photograph by whole pixels."""
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    photograph = data.astronaut()

    def frame(k: int, step: tuple[int, int] = (3, 2)) -> np.ndarray:
        x, y = 40 + step[0] * k, 30 + step[1] * k
        return np.ascontiguousarray(photograph[y : y + 240, x : x + 320])

    return frame


@pytest.fixture
def frame_folder(moving_photo, tmp_path: Path) -> Path:
    """Six frames of it as PNG files."""
    from PIL import Image

    folder = tmp_path / "frames"
    folder.mkdir()
    for k in range(6):
        Image.fromarray(moving_photo(k)).save(folder / f"{k:03d}.png")
    return folder


@dataclass(frozen=True)
class Drive:
    """Tracks of random points that a camera passes, and its true path."""

    camera: Camera
    frames: list[TrackedFrame]
    truth: Trajectory


@pytest.fixture(scope="session")
def drive() -> Callable[..., Drive]:
    """Draw a drive through points: forward, with a slow turn."""

    def draw(
        count: int = 25, noise_px: float = 0.0, moving: int = 0, standing: int = 0, seed: int = 0
    ) -> Drive:
        rng = np.random.default_rng(seed)
        camera = Camera(SIZE, 500.0)
        points = rng.uniform((-15, -6, 4), (15, 3, 60), (1500, 3))
        turns, centres = [], []
        centre = np.zeros(3)
        for k in range(count):
            angle = np.radians(0.3 * k)
            turn = np.array(
                [
                    [np.cos(angle), 0, np.sin(angle)],
                    [0, 1, 0],
                    [-np.sin(angle), 0, np.cos(angle)],
                ]
            )
            turns.append(turn)
            centres.append(centre)
            if k >= standing:
                centre = centre + turn @ [0.02, 0, 0.8]
        born: dict[int, int] = {}
        frames = []
        for k, (turn, centre) in enumerate(zip(turns, centres, strict=True)):
            seen = points.copy()
            seen[:moving] += [0.5 * k, 0, 0.2 * k]  # on something that drives
            inside_camera = (seen - centre) @ turn
            xy = camera.project(inside_camera) + rng.normal(0, noise_px or 1e-9, (len(seen), 2))
            visible = (inside_camera[:, 2] > 1) & (xy >= 0).all(1) & (xy < SIZE).all(1)
            tracks = np.flatnonzero(visible)
            ages = np.array([k - born.setdefault(track, k) for track in tracks.tolist()])
            scores = np.ones(len(tracks), np.float32)
            frames.append(TrackedFrame(k, tracks, xy[visible].astype(np.float32), scores, ages))
        truth = Trajectory(np.arange(count), np.array(turns), np.array(centres))
        return Drive(camera, frames, truth)

    return draw
