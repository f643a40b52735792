"""Oxford Affine Covariant Regions: eight scenes of six images (Mikolajczyk et al., 2005).

The layout is the public one: SCENE/img1.png (or .ppm, .pgm) to img6, SCENE/H1to2p to H1to6p.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from .._shared.errors import ImageError
from .types import PlanarScene, load_planar_scene

KINDS = {
    "bark": "zoom and rotation",
    "bikes": "blur",
    "boat": "zoom and rotation",
    "graf": "viewpoint",
    "leuven": "light and JPEG",
    "trees": "blur",
    "ubc": "light and JPEG",
    "wall": "viewpoint",
}
"""What changes between the images of each scene."""

SCENES = tuple(KINDS)
SUFFIXES = (".png", ".ppm", ".pgm")
LAYOUT = f"the data set has the scenes {', '.join(SCENES)} with img1 to img6 each"


def load_oxford(
    folder: str | Path, truth: Literal["published", "refined"] = "published"
) -> list[PlanarScene]:
    """List the eight scenes, or those of them that are there.

    The "published" truth is in H1toKp; "refined" reads H1toKp.refined where there is one.
    """
    root = Path(folder)
    there = [name for name in SCENES if (root / name).is_dir()]
    if not there:
        raise ImageError(f"there are no Oxford scenes in {folder}: {LAYOUT}")
    return [_load_scene(root / name, truth) for name in there]


def _load_scene(folder: Path, truth: str) -> PlanarScene:
    homographies = [f"H1to{number}p" for number in range(2, 7)]
    if truth == "refined":
        refined = [f"{name}.refined" for name in homographies]
        pairs = zip(homographies, refined, strict=True)
        homographies = [new if (folder / new).exists() else name for name, new in pairs]
    images = [f"img{number}" for number in range(1, 7)]
    return load_planar_scene(
        folder, images, homographies, SUFFIXES, LAYOUT, KINDS.get(folder.name, "")
    )
