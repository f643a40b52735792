"""Whether refinement makes a homography better: correlation before and after, on each pair.

    python benchmarks/homography_refinement.py OXFORD [--facade STRECHA]

On all 40 pairs of OXFORD, and on neighbouring photographs of a facade (Strecha's layout), whose
plane it is. Printed are the median local ZNCC over the overlap with the homography of sparse
matches and with the refined one, and on which fraction of the windows that changed by more than
0.001 it rose. The correlation is of the whole overlap; the refinement judges its steps on parts of
it that they were not fitted to.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from deepdetect.datasets.oxford import load_oxford
from deepdetect.datasets.posed_images import load_posed_scenes
from deepdetect.geometry.zncc import erode_mask, gaussian_blur, local_zncc, warp_to_reference
from deepdetect.io.image import load_image, luma
from deepdetect.matching.guided.homography import refine_guiding_homography
from deepdetect.matching.guided.initial_geometry import find_initial_geometry
from deepdetect.matching.guided.options import HomographyMatchingOptions

BLUR_SIGMA_PX = 1.0
CHANGE = 0.001
NEIGHBOURS = 2


def main() -> None:
    """Print a row for each pair."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("oxford", type=Path)
    parser.add_argument("--facade", type=Path, help="folder of a scene with cameras")
    args = parser.parse_args()
    print("| pair | ZNCC before | after | windows better |\n|---|---:|---:|---:|")
    worse = count = 0
    for name, first, second in _pairs(args.oxford, args.facade):
        grays = luma(load_image(first)), luma(load_image(second))
        start = find_initial_geometry(*grays, "homography").matrix
        if start is None:
            print(f"| {name} | no homography | | |", flush=True)
            continue
        refined = refine_guiding_homography(*grays, start, HomographyMatchingOptions())
        before, after = (_correlation(*grays, matrix) for matrix in (start, refined))
        known = np.isfinite(before) & np.isfinite(after)
        rise = (after - before)[known]
        changed = np.abs(rise) > CHANGE
        better = f"{(rise[changed] > 0).mean():.1%}" if changed.any() else "unchanged"
        medians = [float(np.median(values[known])) for values in (before, after)]
        worse += medians[1] < medians[0]
        count += 1
        print(f"| {name} | {medians[0]:.4f} | {medians[1]:.4f} | {better} |", flush=True)
    print(f"\nLower afterwards: {worse} of {count} pairs.")


def _pairs(oxford: Path, facade: Path | None) -> Iterator[tuple[str, Path, Path]]:
    for scene in load_oxford(oxford):
        for number, pair in enumerate(scene.pairs(), 2):
            yield f"{scene.name} 1-{number}", pair.first, pair.second
    if facade is not None:
        for posed in load_posed_scenes(facade):
            images = sorted(
                {view.path for pair in posed.pairs for view in (pair.first, pair.second)}
            )
            for distance in range(1, NEIGHBOURS + 1):
                for one, other in zip(images, images[distance:], strict=False):
                    yield f"{posed.name} {one.stem}-{other.stem}", one, other


def _correlation(gray0: np.ndarray, gray1: np.ndarray, homography: np.ndarray) -> np.ndarray:
    size = (gray0.shape[1], gray0.shape[0])
    warped, shown = warp_to_reference(gray1, homography, size)
    first, second = (gaussian_blur(gray, BLUR_SIGMA_PX) for gray in (gray0, warped))
    return local_zncc(first, second, erode_mask(shown, BLUR_SIGMA_PX))


if __name__ == "__main__":
    main()
