"""Compare our rectified matching with OpenCV's semi-global matching: points, accuracy, time.

    python benchmarks/row_matching.py DATA

DATA contains the Middlebury scenes, as SCENE/left.png, right.png, disparity.png and calib.json. The
rows of each scene are:

- keypoints: the disparity map at the keypoints of the `dense` weights;
- every: the disparity map at every pixel, with default options;
- edges: every pixel, also near disparity discontinuities;
- parabola: as edges, but without `refine_disparity`: disparities are the minima of parabolas
  through the costs of three integer disparities;
- dense: as edges, with occlusions filled;
- matched: the pixels of dense that are not filled;
- SGBM: OpenCV's, with the range of the ground truth, rounded up to a multiple of 16;
- SGBM, framed: as SGBM, but with both views padded on the left by that range, so that OpenCV also
  gives values where the right view shows nothing.

The columns are: the number of points; the fraction of those with known ground truth that is within
0.25, 0.5, 1, 2 and 4 px of it; completeness, which is the fraction of the pixels with known ground
truth, including occluded ones, that have a point within 1 px; "tenths of a pixel"; and seconds. For
"tenths of a pixel", the fractional parts of disparities are counted in ten bins, and each count is
divided by that of the ground truth, unless the latter is rounded. The smallest and the largest
ratio are given; they are far from 1 if the disparity map has terraces.

The ground truth of dolls belongs to a view that is two baselines away from its left photograph. Its
rows are given with the ground truth of the file, and with that moved to the photograph's view.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from deepdetect import DeepDetect, disparity_map
from deepdetect._shared.errors import ImageError
from deepdetect.io.image import load_image, luma
from deepdetect.matching.stereo import DENSE, DisparityOptions
from deepdetect.matching.stereo.sgm import semi_global_matching
from deepdetect_lab.datasets.middlebury import load_motorcycle
from deepdetect_lab.evaluation.protocols.stereo import ground_truths
from deepdetect_lab.evaluation.protocols.stereo_pipelines import sgbm_disparity
from deepdetect_lab.evaluation.report import Row, Table

TOLERANCES = (0.25, 0.5, 1.0, 2.0, 4.0)
AT_EDGES = DisparityOptions(uniqueness_ratio=1.0, discontinuity_margin_px=0)
SEARCH_WITHOUT_TRUTH = 64
"""Number of disparities that OpenCV tries without ground truth. Chosen by hand."""

COLUMNS = {
    **{"scene": "", "way": "", "points": ",d"},
    **{f"within {tolerance:g} px": ".4f" for tolerance in TOLERANCES},
    **{"completeness": ".4f", "tenths of a pixel": "", "seconds": ".2f"},
}


def main() -> None:
    """Print a table with a row for each scene and way."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of the scenes")
    parser.add_argument("--repeats", type=int, default=3, help="runs; the fastest one is taken")
    arguments = parser.parse_args()
    detector = DeepDetect("dense")
    rows: list[Row] = []
    for name, left, right, known in scenes(arguments.data):
        keypoints = detector.detect(left).xy
        for way, compute in ways(left, right, keypoints, search_count(known)).items():
            compute()  # the first call compiles
            seconds = []
            for _ in range(arguments.repeats):
                started = time.perf_counter()
                found = compute()
                seconds.append(time.perf_counter() - started)
            for note, truth in known.items():
                row = {"scene": name + note, "way": way, "seconds": min(seconds)}
                rows.append(row | scores(found, truth))
    print(Table("rows", "", COLUMNS, rows).to_markdown())


def ways(
    left: np.ndarray, right: np.ndarray, keypoints: np.ndarray, count: int
) -> dict[str, Callable[[], np.ndarray]]:
    """Return the functions that compute disparity maps, by the names of the rows."""
    row, column = np.indices(left.shape[:2])
    every = np.column_stack([column.ravel(), row.ravel()])
    return {
        "keypoints": lambda: ours(left, right, keypoints),
        "every": lambda: ours(left, right, every),
        "edges": lambda: ours(left, right, every, AT_EDGES),
        "parabola": lambda: by_parabola(left, right),
        "dense": lambda: ours(left, right, every, DENSE),
        "matched": lambda: ours(left, right, every, DENSE, filled=False),
        "SGBM": lambda: sgbm_disparity(left, right, count),
        "SGBM, framed": lambda: sgbm_disparity(left, right, count, (count, 0)),
    }


def scenes(
    data: Path,
) -> Iterator[tuple[str, np.ndarray, np.ndarray, dict[str, np.ndarray | None]]]:
    """Yield name, both views and ground truths of the Motorcycle pair and the scenes in DATA."""
    pair = load_motorcycle()
    yield pair.name, pair.left, pair.right, {"": pair.disparity}
    for folder in sorted(path.parent for path in data.glob("*/left.png")):
        try:
            found: dict[str, np.ndarray | None] = dict(ground_truths(folder))
        except ImageError:
            found = {"": None}
        yield (
            folder.name,
            load_image(folder / "left.png"),
            load_image(folder / "right.png"),
            {f", {name}" if name else "": truth for name, truth in found.items()},
        )


def ours(
    left: np.ndarray,
    right: np.ndarray,
    xy: np.ndarray,
    options: DisparityOptions = DisparityOptions(),
    filled: bool = True,
) -> np.ndarray:
    """Return a map of our disparities at (N, 2) positions, NaN elsewhere."""
    found = disparity_map(left, right, options).at(xy)
    kept = found.matched | filled
    out = np.full(left.shape[:2], np.nan, np.float32)
    column, row = xy[found.indices[kept]].astype(int).T
    out[row, column] = found.disparity[kept]
    return out


def by_parabola(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the map from which `refine_disparity` starts, at the pixels that it keeps."""
    kept = disparity_map(left, right, AT_EDGES)
    assert kept.disparity_range is not None
    found = semi_global_matching(luma(left), luma(right), kept.disparity_range)
    return np.where(np.isfinite(kept.disparity), found.disparity, np.float32(np.nan))


def search_count(known: dict[str, np.ndarray | None]) -> int:
    """Return the number of disparities that OpenCV tries."""
    truth = known[""]
    if truth is None:
        return SEARCH_WITHOUT_TRUTH
    return -(-(int(np.nanmax(truth)) + 2) // 16) * 16


def scores(found: np.ndarray, truth: np.ndarray | None) -> Row:
    """Return the number of points, fractions within tolerances, completeness, tenths of a pixel."""
    points = int(np.isfinite(found).sum())
    if truth is None:
        return {"points": points}
    errors = np.abs(found - truth)
    errors = errors[np.isfinite(errors)]
    return {
        "points": points,
        **{f"within {t:g} px": float(np.mean(errors <= t)) for t in TOLERANCES},
        "completeness": np.count_nonzero(errors <= 1) / np.count_nonzero(np.isfinite(truth)),
        "tenths of a pixel": tenths(found, truth),
    }


def tenths(found: np.ndarray, truth: np.ndarray) -> str | None:
    """Return the least and the largest frequency of a tenth of a pixel, relative to ground truth.

    None if the ground truth is rounded to parts of a pixel.
    """
    both = np.isfinite(found) & np.isfinite(truth)
    counts, expected = (
        np.histogram(disparity[both] % 1, bins=10, range=(0, 1))[0] for disparity in (found, truth)
    )
    if not expected.all():
        return None
    ratios = counts / expected
    return f"{ratios.min():.2f} to {ratios.max():.2f}"


if __name__ == "__main__":
    main()
