"""Oxford Affine Covariant Regions: eight scenes of six images (Mikolajczyk et al., 2005).

The layout is the public one: SCENE/img1.png (or .ppm, .pgm) to img6, SCENE/H1to2p to H1to6p.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from .._shared.errors import ImageError, OptionError, unknown_name
from .types import PlanarScene, read_homography

SCENES = ("bark", "bikes", "boat", "graf", "leuven", "trees", "ubc", "wall")
ENDINGS = (".png", ".ppm", ".pgm")


def load_oxford(
    folder: str | Path, truth: Literal["published", "refined"] = "published"
) -> list[PlanarScene]:
    """List the eight scenes.

    Args:
        folder: the data set.
        truth: "published" reads H1toKp; "refined" reads H1toKp.refined where there is one.

    Raises:
        ImageError: a file is missing.
        OptionError: the truth is unknown.
    """
    if truth not in ("published", "refined"):
        raise unknown_name("truth", truth, ("published", "refined"))
    root = Path(folder)
    return [_load_scene(root / name, truth) for name in SCENES]


def find_scene(scenes: list[PlanarScene], name: str) -> PlanarScene:
    """Find a scene by name.

    Raises:
        OptionError: there is none of the name.
    """
    for scene in scenes:
        if scene.name == name:
            return scene
    raise OptionError(f"there is no scene {name!r}: known are {', '.join(s.name for s in scenes)}")


def _load_scene(folder: Path, truth: str) -> PlanarScene:
    images = tuple(_image(folder, number) for number in range(1, 7))
    homographies = []
    for number in range(2, 7):
        path = folder / f"H1to{number}p"
        refined = path.with_name(f"{path.name}.refined")
        homographies.append(
            read_homography(refined if truth == "refined" and refined.exists() else path)
        )
    return PlanarScene(folder.name, images, tuple(homographies))


def _image(folder: Path, number: int) -> Path:
    for ending in ENDINGS:
        path = folder / f"img{number}{ending}"
        if path.exists():
            return path
    raise ImageError(
        f"there is no img{number} in {folder}: the folder must hold the eight Oxford scenes "
        f"({', '.join(SCENES)}) with img1 to img6 each"
    )
