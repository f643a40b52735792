"""Estimate more accurate homographies for Oxford from the images alone.

    python benchmarks/refine_oxford.py OXFORD OUTPUT

Writes OUTPUT/SCENE/H1toKp.refined for homographies that are clearly better than the published ones,
which are off by up to 26 px, and prints a table. OUTPUT may be OXFORD itself. The refinement, by
Lucas-Kanade tracking in warped images (`homography_refinement`), starts both from the published
homography and from one estimated by SIFT and MAGSAC, and the result with the higher correlation is
taken. So no detector that the benchmark evaluates determines the result.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from homography_refinement import refine_homography

from deepdetect._shared.atomic import atomic_path
from deepdetect._shared.progress import progress
from deepdetect.features.matchers import get_matcher, match_descriptors
from deepdetect.geometry import GeometryOptions, estimate_geometry, transform_points
from deepdetect.geometry.images import (
    WINDOW_PX,
    median_local_zncc,
    warped_zncc,
)
from deepdetect.io.image import load_image, luma
from deepdetect_lab.datasets.planar import PlanarPair, load_oxford
from deepdetect_lab.evaluation.metrics.homography import project_visible
from deepdetect_lab.evaluation.report import Row, Table

CLEAR_GAIN = 0.01
"""A homography is accepted if the median correlation rises by more than this. Chosen by hand."""

CLEAR_MAJORITY = 0.6
"""If the gain is at most `CLEAR_GAIN`, the correlation must rise in more than this fraction of the
windows. Blurred or flat images gain little, since they correlate nearly as well when they are a
pixel off. With lens distortion, one part of an image can gain while others lose. Chosen by hand."""

MAX_APART = 0.5
"""Both starts count as converged to the same homography if their results differ by less than this
fraction of the distance between the better result and the published homography. Both distances are
medians over the overlap. Chosen by hand."""

COLUMNS = {
    "pair": "",
    "correlation, published": ".3f",
    "correlation, refined": ".3f",
    "moved, median px": ".2f",
    "moved, largest px": ".1f",
    "windows in which it rises": ".1%",
    "two starts apart, median px": ".3f",
    "written": "",
}
"""Columns with their number formats. "Correlation" is the median of local correlations over the
overlap. "Moved" is the distance between the mappings of a pixel by both homographies."""

START_RATIO = 0.85
START_KEYPOINTS = 8000
"""Limit of the ratio test and number of SIFT keypoints for the second start. Chosen by hand."""


def main() -> None:
    """Refine the pairs, write files and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("oxford", type=Path, help="the data set")
    parser.add_argument("output", type=Path, help="folder for the files")
    arguments = parser.parse_args()
    rows = refine_oxford(arguments.oxford, arguments.output, quiet=False)
    print(Table("refined", "", COLUMNS, rows).to_markdown())


def refine_oxford(folder: Path, output: Path, *, quiet: bool = True) -> list[Row]:
    """Refine all pairs, and write SCENE/H1toKp.refined if it is better than the published one."""
    rows = []
    pairs = [pair for scene in load_oxford(folder) for pair in scene.pairs]
    with progress(len(pairs), "refining", "pair", quiet) as bar:
        for pair in pairs:
            rows.append(_refine(pair, output / pair.scene / f"H1to{pair.number}p.refined"))
            bar.update(1)
    return rows


def _refine(pair: PlanarPair, path: Path) -> Row:
    gray0, gray1 = (luma(load_image(image)) for image in (pair.first, pair.second))
    found = [refine_homography(gray0, gray1, pair.homography)]
    start = sift_homography(gray0, gray1)
    if start is not None:
        found.append(refine_homography(gray0, gray1, start))
    published, *refined = (
        median_local_zncc(gray0, gray1, homography) for homography in (pair.homography, *found)
    )
    zncc = max(refined)
    best = found[refined.index(zncc)]
    sizes = (gray0.shape[1], gray0.shape[0]), (gray1.shape[1], gray1.shape[0])
    moved = displacement(best, pair.homography, *sizes)
    apart = displacement(*found, *sizes)[0] if len(found) > 1 else None
    risen = risen_fraction(gray0, gray1, pair.homography, best)
    written = is_better(zncc - published, moved[0], risen, apart)
    if written:
        with atomic_path(path) as temporary:
            np.savetxt(temporary, best, fmt="%.12e")
    values = pair.name, published, zncc, *moved, risen, apart, "yes" if written else "no"
    return dict(zip(COLUMNS, values, strict=True))


def is_better(gain: float, moved: float, risen: float, apart: float | None) -> bool:
    """Return whether a refined homography is clearly better than the published one.

    This holds if its correlation is much higher, or if the correlation rises in a clear majority of
    the windows and both starts converge to the same homography. `moved` and `apart` are the medians
    in pixels that `displacement` returns.
    """
    same = apart is not None and apart < MAX_APART * moved
    return gain > CLEAR_GAIN or (same and risen > CLEAR_MAJORITY)


def sift_homography(gray0: np.ndarray, gray1: np.ndarray) -> np.ndarray | None:
    """Estimate a homography by SIFT, ratio test and MAGSAC; None if that fails."""
    sift = cv2.SIFT_create(nfeatures=START_KEYPOINTS)
    found = [sift.detectAndCompute(gray, None) for gray in (gray0, gray1)]
    if any(descriptors is None for _, descriptors in found):
        return None
    points = [cv2.KeyPoint_convert(keypoints) for keypoints, _ in found]
    matches = match_descriptors(found[0][1], found[1][1], get_matcher("exact"), ratio=START_RATIO)
    options = GeometryOptions(inlier_threshold=3.0)
    return estimate_geometry(
        points[0][matches.indices0], points[1][matches.indices1], "homography", options=options
    ).matrix


def risen_fraction(
    gray0: np.ndarray, gray1: np.ndarray, before: np.ndarray, after: np.ndarray
) -> float:
    """Return the fraction of the windows whose correlation rises.

    Windows do not overlap. Windows whose correlation stays equal are left out.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        before, after: (3, 3) homographies from the first to the second.

    Returns:
        A fraction in [0, 1]; 0 if nothing changed.
    """
    values = []
    for homography in (before, after):
        every = warped_zncc(gray0, gray1, homography)
        values.append(every[WINDOW_PX // 2 :: WINDOW_PX, WINDOW_PX // 2 :: WINDOW_PX])
    risen, fallen = (int(np.count_nonzero(one > other)) for one, other in (values[::-1], values))
    return risen / (risen + fallen) if risen + fallen else 0.0


def displacement(
    homography: np.ndarray,
    other: np.ndarray,
    size0: tuple[int, int],
    size1: tuple[int, int],
) -> tuple[float, float]:
    """Map the pixels of the overlap by two homographies; return distances between the results.

    Returns:
        The median and the largest distance in pixels; NaN without an overlap.
    """
    row, column = np.indices((size0[1], size0[0]))
    grid = np.column_stack([column.ravel(), row.ravel()])
    mapped = project_visible(grid, homography, size1)
    seen = np.isfinite(mapped[:, 0])
    gaps = np.linalg.norm(mapped[seen] - transform_points(grid[seen], other), axis=1)
    if not len(gaps):
        return float("nan"), float("nan")
    return float(np.median(gaps)), float(gaps.max())


if __name__ == "__main__":
    main()
