"""Planar scenes with true homographies: Oxford, HPatches, and the paper's badly visible pairs."""

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

NOT_IN_D2NET_SUBSET = {
    *("i_contruction", "i_crownnight", "i_dc", "i_pencils", "i_whitebuilding"),
    *("v_artisans", "v_astronautis", "v_talent"),
}
"""The eight scenes of HPatches beyond 1600x1200, which most papers leave out (D2-Net's list)."""


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
    """A scene: the pairs of its first image with each other one."""

    name: str
    pairs: tuple[PlanarPair, ...]

    @property
    def images(self) -> list[Path]:
        """All of its images."""
        return [self.pairs[0].first, *(pair.second for pair in self.pairs)]

    def with_max_pairs(self, max_pairs: int) -> PlanarScene:
        """Return the scene with evenly spaced ones of its pairs, at most so many; one: the last."""
        kept = self.pairs[-1:] if max_pairs == 1 else evenly_spaced(self.pairs, max_pairs)
        return replace(self, pairs=tuple(kept))


def load_oxford(
    folder: str | Path, truth: Literal["published", "refined"] = "published"
) -> list[PlanarScene]:
    """List the eight scenes (Mikolajczyk et al., 2005), or those of them that are there.

    The "published" truth is in H1toKp; "refined" reads H1toKp.refined where there is one.
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
    """List the scenes that are there (Balntas et al., 2017): 116 in the whole set.

    The folders i_NAME (light) and v_NAME (viewpoint) hold 1.ppm (or .png) to 6, H_1_2 to H_1_6.
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
    """List the paper's dusty and smoky scenes: SCENE/img1, SCENE/img2 (.png or .bmp), H1to2p."""
    layout = "the folder must hold dusty and smoky"
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
    """Load images, PREFIX1 and so on, and the homographies from the first to each of the others.

    The suffixes are looked for in this order; `layout` says what the folder must hold.
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
