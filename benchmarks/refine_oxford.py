"""More accurate homographies for Oxford, estimated from the images alone.

    python benchmarks/refine_oxford.py OXFORD OUTPUT

Writes OUTPUT/SCENE/H1toKp.refined where they are clearly better than the published ones, and a
report to OUTPUT/refinement; OUTPUT may be OXFORD itself. The published ones are up to 26 px off. No
keypoint detector that the benchmark evaluates is in the loop at the end: Lucas-Kanade on the warped
images (`geometry.homography_refinement`) starts from the published homography and from one by SIFT
and MAGSAC, and what correlates best is taken.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from deepdetect._shared.atomic import atomic_path
from deepdetect._shared.progress import progress
from deepdetect._shared.provenance import provenance
from deepdetect.datasets.planar import PlanarPair, load_oxford, read_matrix
from deepdetect.evaluation.metrics.homography import project_visible
from deepdetect.evaluation.report import Report, Row, Section, Table
from deepdetect.features.matchers import get_matcher, match_descriptors
from deepdetect.geometry import GeometryOptions, estimate_geometry, transform_points
from deepdetect.geometry.homography_refinement import refine_homography
from deepdetect.geometry.images import (
    BLUR_SIGMA_PX,
    WINDOW_PX,
    erode_mask,
    gaussian_blur,
    local_zncc,
    median_local_zncc,
    warp_to_reference,
)
from deepdetect.io.image import load_image, luma

CLEAR_GAIN = 0.01
"""Gain in the median correlation that is clear by itself."""

CLEAR_MAJORITY = 0.6
"""Fraction of the windows in which the correlation must rise where the gain is smaller. Blurred or
flat images correlate nearly as well when they are a pixel off, so their gain is small; and a gain
can come from a part of the image at the cost of the rest, as under a lens that bends lines."""

MAX_APART = 0.5
"""Distance of what was found from both starts over the distance that it moved from the published
homography, medians over the overlap: up to this both starts found the same."""

COLUMNS = {
    "pair": "",
    "correlation, published": ".3f",
    "correlation, refined": ".3f",
    "moved, median px": ".2f",
    "moved, largest px": ".1f",
    "windows in which it rises": ".1%",
    "two starts apart, median px": ".3f",
    "from the file there, median px": ".3f",
    "from the file there, largest px": ".2f",
    "written": "",
}

START_RATIO = 0.85
START_KEYPOINTS = 8000


@dataclass(frozen=True, eq=False)
class RefinedPair:
    """A pair of Oxford with its refined homography.

    Attributes:
        pair: as published.
        published: median local correlation of the images under the published homography.
        homography: the best found, from either start.
        zncc: the correlation under it.
        moved: how far points of the overlap move from the published place: median and largest,
            in pixels.
        risen: fraction of the windows, side by side, in which the correlation rises.
        starts_apart: how far the results from both starts take points apart, median and largest;
            None without a second start.
        apart: the same from the refined homography that the data set has already; None without.
        written: the file, or None where the published homography is as good.
    """

    pair: PlanarPair
    published: float
    homography: np.ndarray
    zncc: float
    moved: tuple[float, float]
    risen: float
    starts_apart: tuple[float, float] | None
    apart: tuple[float, float] | None
    written: Path | None

    @property
    def better(self) -> bool:
        """Whether the refined homography is clearly better than the published one.

        It gains much correlation; or the correlation rises in a clear majority of the windows, and
        both starts lead to the same place.
        """
        if self.zncc - self.published > CLEAR_GAIN:
            return True
        same = self.starts_apart is not None and self.starts_apart[0] < MAX_APART * self.moved[0]
        return same and self.risen > CLEAR_MAJORITY


def main() -> None:
    """Refine the pairs, and write files and report."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("oxford", type=Path, help="the data set")
    parser.add_argument("output", type=Path, help="where the files go")
    arguments = parser.parse_args()
    results = refine_oxford(arguments.oxford, arguments.output, quiet=False)
    section = Section("Oxford's homographies, refined", (), (refinement_table(results),))
    report = Report("DeepDetect: refined homographies of Oxford", provenance(), (section,))
    report.save(arguments.output / "refinement")
    written = sum(result.written is not None for result in results)
    print(f"{section.tables[0].to_markdown()}\n\n{written} files written to {arguments.output}")


def refine_oxford(folder: Path, output: Path, *, quiet: bool = True) -> list[RefinedPair]:
    """Refine all pairs, and write SCENE/H1toKp.refined where it is better than the published.

    Args:
        folder: the data set; nothing is written into it unless it is the output too.
        output: where the files go.
        quiet: show no progress bar.

    Raises:
        ImageError: a file of the data set is missing.
        DeepDetectError: a file cannot be written.
    """
    results = []
    pairs = [pair for scene in load_oxford(folder) for pair in scene.pairs]
    with progress(len(pairs), "refining", "pair", quiet) as bar:
        for pair in pairs:
            results.append(_refine(pair, output / pair.scene / f"H1to{pair.number}p.refined"))
            bar.update(1)
    return results


def _refine(pair: PlanarPair, path: Path) -> RefinedPair:
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
    size0, size1 = ((gray.shape[1], gray.shape[0]) for gray in (gray0, gray1))
    moved = displacement(best, pair.homography, size0, size1)
    there = pair.first.with_name(path.name)  # read before it may be written over
    apart = None
    if there.exists():
        apart = displacement(best, read_matrix(there), size0, size1)
    starts_apart = None
    if len(found) > 1:
        starts_apart = displacement(*found, size0, size1)
    risen = risen_fraction(gray0, gray1, pair.homography, best)
    result = RefinedPair(pair, published, best, zncc, moved, risen, starts_apart, apart, None)
    if not result.better:
        return result
    with atomic_path(path) as temporary:
        np.savetxt(temporary, best, fmt="%.12e")
    return replace(result, written=path)


def sift_homography(gray0: np.ndarray, gray1: np.ndarray) -> np.ndarray | None:
    """Estimate a homography by SIFT, ratio test and MAGSAC; None where that fails."""
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
    """Return the fraction of the windows in which the images correlate more than before.

    The windows lie side by side. Those that correlate equally are left out.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        before, after: (3, 3) homographies from the first to the second.

    Returns:
        In [0, 1]; 0 where nothing changed.
    """
    values = []
    for homography in (before, after):
        size = (gray0.shape[1], gray0.shape[0])
        warped, valid_mask = warp_to_reference(gray1, homography, size)
        first, second = (gaussian_blur(gray, BLUR_SIGMA_PX) for gray in (gray0, warped))
        every = local_zncc(first, second, erode_mask(valid_mask, BLUR_SIGMA_PX))
        values.append(every[WINDOW_PX // 2 :: WINDOW_PX, WINDOW_PX // 2 :: WINDOW_PX])
    risen, fallen = (int(np.count_nonzero(one > other)) for one, other in (values[::-1], values))
    return risen / (risen + fallen) if risen + fallen else 0.0


def displacement(
    homography: np.ndarray,
    other: np.ndarray,
    size0: tuple[int, int],
    size1: tuple[int, int],
) -> tuple[float, float]:
    """Return how far two homographies take the pixels of the overlap apart.

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


def refinement_table(results: list[RefinedPair]) -> Table:
    """Tabulate the correlations and how far points move."""
    rows: list[Row] = []
    for result in results:
        row = {
            "pair": result.pair.name,
            "correlation, published": result.published,
            "correlation, refined": result.zncc,
            "moved, median px": result.moved[0],
            "moved, largest px": result.moved[1],
            "windows in which it rises": result.risen,
            "written": "yes" if result.written else "no: not clearly better",
        }
        if result.starts_apart:
            row["two starts apart, median px"] = result.starts_apart[0]
        if result.apart:
            row["from the file there, median px"] = result.apart[0]
            row["from the file there, largest px"] = result.apart[1]
        rows.append(row)
    note = (
        "Median of the local correlations (15x15 pixels) of the images over their overlap. Moved: "
        "from where the published homography takes the pixels of the overlap. Written where the "
        f"correlation gains over {CLEAR_GAIN:g}, or where it rises in over {CLEAR_MAJORITY:.0%} of "
        f"the windows and both starts come within {MAX_APART:g} of the move. From the file there: "
        "the same from H1toKp.refined, where the data set has that file already."
    )
    return Table("oxford_refined", "Oxford's homographies, refined", COLUMNS, rows, note)


if __name__ == "__main__":
    main()
