"""Scenes with ground truth: planar ones with homographies, stereo pairs with disparity."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .._shared.errors import ImageError
from ..geometry.camera import Calibration
from .pair_selection import evenly_spaced


@dataclass(frozen=True, eq=False)
class PlanarPair:
    """Two images of a plane, or from one point of view; the first one's number is 1.

    The (3, 3) homography takes columns (x, y, 1) of the first image to the second; centre of the
    first pixel (0, 0). `kind` is what changes between them, "" where the data set does not say.
    """

    scene: str
    number: int
    first: Path
    second: Path
    homography: np.ndarray
    kind: str = ""

    @property
    def name(self) -> str:
        """As papers write it: "graf 1-6"."""
        return f"{self.scene} 1-{self.number}"


@dataclass(frozen=True, eq=False)
class PlanarScene:
    """A scene: its first image, and others with their homographies from the first.

    `numbers` are those of the others; empty for 2, 3 and so on.
    """

    name: str
    images: tuple[Path, ...]
    homographies: tuple[np.ndarray, ...]
    kind: str = ""
    numbers: tuple[int, ...] = ()

    def pairs(self) -> Iterator[PlanarPair]:
        """Yield the pairs of the first image with each other one."""
        numbers = self.numbers or range(2, 2 + len(self.homographies))
        rows = zip(numbers, self.images[1:], self.homographies, strict=True)
        for number, image, homography in rows:
            yield PlanarPair(self.name, number, self.images[0], image, homography, self.kind)

    def with_max_pairs(self, max_pairs: int) -> PlanarScene:
        """Return the scene with evenly spaced ones of its pairs, at most so many; one: the last."""
        every = list(self.pairs())
        kept = every[-1:] if max_pairs == 1 else evenly_spaced(every, max_pairs)
        if len(kept) == len(every):
            return self
        return replace(
            self,
            images=(self.images[0], *(pair.second for pair in kept)),
            homographies=tuple(pair.homography for pair in kept),
            numbers=tuple(pair.number for pair in kept),
        )


@dataclass(frozen=True, eq=False)
class StereoPair:
    """Two rectified views: the match of the left (x, y) is the right (x - disparity, y).

    Attributes:
        name: the scene's name.
        left, right: (H, W, 3) uint8 RGB.
        disparity: (H, W) float32 true disparity of the left view in pixels, NaN where it is
            unknown.
    """

    name: str
    left: np.ndarray
    right: np.ndarray
    disparity: np.ndarray


@dataclass(frozen=True, eq=False)
class CalibratedStereoPair(StereoPair):
    """A rectified pair with the calibration of its cameras."""

    calibration: Calibration


def read_homography(path: Path) -> np.ndarray:
    """Read nine numbers from a text file as a (3, 3) float64 matrix."""
    try:
        matrix = np.array(path.read_text().split(), np.float64).reshape(3, 3)
    except OSError as error:
        raise ImageError(f"{path} cannot be read ({error.strerror}): check the folder") from None
    except ValueError:
        raise ImageError(f"{path} holds no 3x3 matrix: nine numbers are expected") from None
    if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-12:
        raise ImageError(f"{path} holds no homography: the matrix cannot be inverted")
    return matrix


def load_planar_scene(
    folder: Path,
    images: Sequence[str],
    homographies: Sequence[str],
    suffixes: Sequence[str],
    layout: str,
    kind: str = "",
) -> PlanarScene:
    """Load a scene from a folder: images, named without their suffixes, and homographies.

    The suffixes are looked for in this order; `layout` says what the folder must hold.
    """
    files = []
    for name in images:
        found = [path for end in suffixes if (path := folder / f"{name}{end}").exists()]
        if not found:
            raise ImageError(f"there is no image {name} in {folder}: {layout}")
        files.append(found[0])
    matrices = tuple(read_homography(folder / name) for name in homographies)
    return PlanarScene(folder.name, tuple(files), matrices, kind)
