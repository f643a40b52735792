"""Small data sets with known homographies, and a detector that needs no network."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect import DeepDetect, Keypoints, SelectionOptions
from deepdetect.detector.backends import RuntimeOptions
from deepdetect.detector.heatmap import HeatmapOptions
from deepdetect.detector.pretrained import pretrained_weights
from deepdetect.features import select_keypoints
from deepdetect.io.image import load_image, luma

SCENES = ("bark", "bikes", "boat", "graf", "leuven", "trees", "ubc", "wall")
MOVES = {
    "boat": [[1, 0, -5], [0, 1, 3], [0, 0, 1]],
    "graf": [[0.98, 0.03, 2], [-0.02, 1.01, 1], [2e-4, -1e-4, 1]],
    "wall": [[1, 0, 2], [0, 1, -4], [0, 0, 1]],
}
"""From each image to the next; nothing moves in the other scenes."""


class EdgeDetector(DeepDetect):
    """A stand-in whose heat map is the strength of the edges."""

    def __init__(self) -> None:
        self.weights = pretrained_weights()
        self.backend = "none"
        self.heatmap_options = HeatmapOptions()
        self._runtime = RuntimeOptions()  # of `with_weights`

    def heatmap_and_logits(
        self, image: np.ndarray, *, channels: str = "rgb"
    ) -> tuple[np.ndarray, np.ndarray]:
        gray = luma(load_image(image)).astype(np.float32)
        strength = np.hypot(cv2.Sobel(gray, -1, 1, 0), cv2.Sobel(gray, -1, 0, 1))
        return 1 - np.exp(-strength / 150), strength

    def heatmap(self, image: np.ndarray, *, channels: str = "rgb") -> np.ndarray:
        return self.heatmap_and_logits(image)[0]

    def _select(
        self,
        rgb: np.ndarray,
        options: SelectionOptions = SelectionOptions(),
        ignore: np.ndarray | None = None,
    ) -> Keypoints:
        heatmap, logits = self.heatmap_and_logits(rgb)
        return select_keypoints(heatmap, options, logits, ignore=ignore)


@pytest.fixture(scope="session")
def edge_detector() -> DeepDetect:
    return EdgeDetector()


@pytest.fixture(scope="session")
def oxford_folder(tmp_path_factory: pytest.TempPathFactory, write_scene) -> Path:
    """Eight scenes of small images: only boat's are large enough for ORB; ubc 6 equals 1."""
    root = tmp_path_factory.mktemp("data")
    for index, scene in enumerate(SCENES):
        size = (94, 86) if scene == "boat" else (40, 32 + index)
        move = np.array(MOVES.get(scene, np.eye(3)), float)
        corner = (100 + 17 * index, 30 + 11 * index)
        write_scene(root / "oxford" / scene, size, move, corner=corner)
    ubc = root / "oxford" / "ubc"
    (ubc / "img6.png").write_bytes((ubc / "img1.png").read_bytes())
    return root


@pytest.fixture(scope="session")
def low_visibility_folder(tmp_path_factory: pytest.TempPathFactory, write_scene) -> Path:
    """Two pairs: of dusty both images are the same, smoky's second one is darker."""
    root = tmp_path_factory.mktemp("low") / "low-visibility"
    for scene, fading in (("dusty", 0.0), ("smoky", 0.4)):
        write_scene(
            *(root / scene, (80, 64), np.eye(3), ("img{}.png", "H1to{}p"), 2),
            corner=(180, 90),
            fading=fading,
        )
    return root


@pytest.fixture(scope="session")
def write_posed_fountain(shared: Path) -> Callable[..., Path]:
    """Write small photographs of the fountain with their cameras."""
    from PIL import Image

    def write(folder: Path, names: Sequence[str], width: int = 384) -> Path:
        folder.mkdir(parents=True)
        source = shared / "data" / "fountain"
        for name in names:
            with Image.open(source / f"{name}.jpg") as image:
                size = (width, round(image.height * width / image.width))
                small = image.resize(size, Image.Resampling.LANCZOS)
                small.save(folder / f"{name}.jpg", quality=95)
            shutil.copy(source / f"{name}.camera", folder)
        return folder

    return write
