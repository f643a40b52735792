"""Small data sets with known homographies, and a detector that needs no network."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from deepdetect import DeepDetect
from deepdetect.detector.backends import RuntimeOptions
from deepdetect.detector.heatmap import HeatmapOptions
from deepdetect.detector.pretrained import pretrained_weights
from deepdetect.io.image import load_image, luma

SCENES = ("bark", "bikes", "boat", "graf", "leuven", "trees", "ubc", "wall")
MOVES = {
    "boat": [[1, 0, -5], [0, 1, 3], [0, 0, 1]],
    "graf": [[0.98, 0.03, 2], [-0.02, 1.01, 1], [2e-4, -1e-4, 1]],
    "wall": [[1, 0, 2], [0, 1, -4], [0, 0, 1]],
}
"""From each image to the next; the other scenes stand still."""


class EdgeDetector(DeepDetect):
    """A stand-in whose heat map is the strength of the edges."""

    def __init__(self) -> None:
        self.weights = pretrained_weights()
        self.backend = "none"
        self.heatmap_options = HeatmapOptions()
        self._runtime = RuntimeOptions()  # of `with_weights`

    def heatmap(self, image: object) -> np.ndarray:
        gray = luma(load_image(image)).astype(np.float32)
        strength = np.hypot(cv2.Sobel(gray, -1, 1, 0), cv2.Sobel(gray, -1, 0, 1))
        return 1 - np.exp(-strength / 150)


@pytest.fixture(scope="session")
def edge_detector() -> DeepDetect:
    return EdgeDetector()


def write_view(
    path: Path, source: np.ndarray, to_view: np.ndarray, size: tuple[int, int], light: float = 1
) -> None:
    view = cv2.warpPerspective(source, to_view, size, flags=cv2.INTER_LINEAR)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.rint(view * light).astype(np.uint8)).save(path)


@pytest.fixture(scope="session")
def write_scene() -> Callable[..., None]:
    """Write images 1 to `count` of a scene and the homographies between them."""
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    photograph = data.astronaut()

    def write(
        folder: Path,
        size: tuple[int, int],
        move: np.ndarray,
        names: tuple[str, str] = ("img{}.png", "H1to{}p"),
        count: int = 6,
        corner: tuple[int, int] = (150, 60),
        fading: float = 0.06,
    ) -> None:
        first = np.array([[1.0, 0, -corner[0]], [0, 1, -corner[1]], [0, 0, 1]])
        total = np.eye(3)
        for number in range(1, count + 1):
            light = 1 - fading * (number - 1)
            write_view(folder / names[0].format(number), photograph, total @ first, size, light)
            if number > 1:
                np.savetxt(folder / names[1].format(number), total)
            total = move @ total

    return write


@pytest.fixture(scope="session")
def oxford_folder(tmp_path_factory: pytest.TempPathFactory, write_scene) -> Path:
    """Eight scenes of small images: only boat's are large enough for ORB; ubc 6 equals 1."""
    root = tmp_path_factory.mktemp("data")
    for index, scene in enumerate(SCENES):
        size = (100, 92) if scene == "boat" else (48, 36 + index)
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
