"""List planar scenes with true homographies: Oxford, HPatches, the paper's low-visibility pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from deepdetect._shared.errors import ImageError
from deepdetect.io.tables import read_matrix

from .pair_selection import evenly_spaced

OXFORD_KINDS = {
    "bark": "zoom and rotation",
    "bikes": "blur",
    "boat": "zoom and rotation",
    "graf": "viewpoint",
    "leuven": "light and JPEG",
    "trees": "blur",
    "ubc": "light and JPEG",
    "wall": "viewpoint",
}
"""What changes between the images of each scene of Oxford Affine Covariant Regions."""

OXFORD_LAYOUT = (
    f"the data set has the scenes {', '.join(OXFORD_KINDS)} with img1 to img6 and H1to2p to H1to6p"
)


@dataclass(frozen=True, eq=False)
class PlanarPair:
    """Two images that a homography relates: they show a plane, or come from one viewpoint.

    `first` is image 1 of the scene, `second` is image `number`. `homography` (3, 3) maps column
    vectors (x, y, 1) of the first image to the second. The centre of the first pixel is (0, 0).
    `kind` says what changes between the images, such as "viewpoint", or is "" if unknown.
    """

    scene: str
    number: int
    first: Path
    second: Path
    homography: np.ndarray
    kind: str = ""

    @property
    def name(self) -> str:
        """Name of the pair as in papers, for example "graf 1-6"."""
        return f"{self.scene} 1-{self.number}"


@dataclass(frozen=True, eq=False)
class PlanarScene:
    """A scene. Each of its pairs consists of the first image and one of the other images."""

    name: str
    pairs: tuple[PlanarPair, ...]

    @property
    def images(self) -> list[Path]:
        """All images of the scene."""
        return [self.pairs[0].first, *(pair.second for pair in self.pairs)]

    def with_max_pairs(self, max_pairs: int) -> PlanarScene:
        """Return the scene with at most `max_pairs` evenly spaced pairs; 1 keeps the last pair."""
        kept = self.pairs[-1:] if max_pairs == 1 else evenly_spaced(self.pairs, max_pairs)
        return replace(self, pairs=tuple(kept))


def load_oxford(
    folder: str | Path, truth: Literal["published", "refined"] = "published"
) -> list[PlanarScene]:
    """List the Oxford scenes in a folder, at most eight (Mikolajczyk et al., 2005).

    The homography to image K is read from the file H1toKp. With the `truth` "refined", it is read
    from H1toKp.refined if that file exists.
    """
    scenes = []
    for name, kind in OXFORD_KINDS.items():
        scene = Path(folder) / name
        if not scene.is_dir():
            continue
        homographies = [f"H1to{number}p" for number in range(2, 7)]
        for k, published in enumerate(homographies if truth == "refined" else ()):
            if (scene / f"{published}.refined").exists():
                homographies[k] += ".refined"
        suffixes = (".png", ".ppm", ".pgm")
        scenes.append(_load_scene(scene, "img", homographies, suffixes, OXFORD_LAYOUT, kind))
    if not scenes:
        raise ImageError(f"there are no Oxford scenes in {folder}: {OXFORD_LAYOUT}")
    return scenes


def load_hpatches(folder: str | Path) -> list[PlanarScene]:
    """List the HPatches scenes in a folder, at most 116 (Balntas et al., 2017).

    The folders i_NAME (light) and v_NAME (viewpoint) hold the images 1.ppm to 6.ppm (or .png) and
    the homographies H_1_2 to H_1_6.
    """
    root = Path(folder)
    homographies = [f"H_1_{number}" for number in range(2, 7)]
    scenes = []
    for prefix, kind in (("i_", "illumination"), ("v_", "viewpoint")):
        for path in sorted(root.glob(f"{prefix}*")):
            if path.is_dir():
                layout = "a scene has images 1 to 6"
                scenes.append(_load_scene(path, "", homographies, (".ppm", ".png"), layout, kind))
    if not scenes:
        raise ImageError(
            f"there are no HPatches scenes in {folder}: it must hold folders i_NAME and v_NAME"
        )
    return scenes


def load_low_visibility(folder: str | Path) -> list[PlanarScene]:
    """List the paper's two low-visibility scenes, in the folders dusty and smoky.

    Each of these folders holds img1 and img2 (.png or .bmp) and the homography H1to2p.
    """
    layout = "the folder must hold the folders dusty and smoky"
    return [
        _load_scene(Path(folder) / name, "img", ("H1to2p",), (".png", ".bmp"), layout)
        for name in ("dusty", "smoky")
    ]


def _load_scene(
    folder: Path,
    prefix: str,
    homographies: Sequence[str],
    suffixes: Sequence[str],
    layout: str,
    kind: str = "",
) -> PlanarScene:
    """List images PREFIX1, PREFIX2, ... and read homographies from the first to each other image.

    For each image, the suffixes are tried in the given order. `layout` is the part of error
    messages that says what the folder must hold.
    """
    files = []
    for number in range(1, len(homographies) + 2):
        names = [folder / f"{prefix}{number}{suffix}" for suffix in suffixes]
        found = [path for path in names if path.exists()]
        if not found:
            raise ImageError(f"there is no image {prefix}{number} in {folder}: {layout}")
        files.append(found[0])
    pairs = [
        PlanarPair(folder.name, number, files[0], file, read_matrix(folder / name), kind)
        for number, (file, name) in enumerate(zip(files[1:], homographies, strict=True), start=2)
    ]
    return PlanarScene(folder.name, tuple(pairs))
