"""Compare guided matching with matching by descriptors alone and with chance.

Guided matching finds many correct matches even for random points. So the number of a detector's
correct matches only means something in comparison with the number for random points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from deepdetect.features.keypoints import nearest_keypoints
from deepdetect.geometry import transform_points
from deepdetect.geometry.transforms import transfer_errors
from deepdetect.io.image import load_image, luma
from deepdetect.matching.guided import Explanation, ImagePair

from ...datasets.planar import PlanarPair
from ..baselines.method import LocalFeature
from ..metrics.homography import corner_error
from ..options import BenchmarkOptions
from ..profiling import profiled
from ..report import Row, Section, Table, where
from ..run import Run
from .paper import CORRECT_PX, PAPER_MATCHING

SEEDS = 3
"""Guided matching runs with this number of seeds, because its counts vary. Chosen by hand."""

COLUMNS = {
    "pair": "",
    "method": "",
    "matchable": ",d",
    "descriptors alone: correct": ",d",
    "descriptors alone: precision": ".2%",
    "guided by": "",
    "guided: correct": ",d",
    "± of correct": ",.0f",
    "guided: precision": ".2%",
    "guided: of the matchable": ".1%",
    "lowest": ".1%",
    "guided: unique": ",d",
    "guided: corner error, px": ".2f",
    "guided: seconds": ".2f",
}

NOTE = (
    f"Correct: matches with an error under {CORRECT_PX:g} px by the true homography; each point of "
    "the first image counts once. Matchable: points of the first image that the true homography "
    "maps to within this distance of a point of the second image. Guided: guided matching runs "
    f"with {SEEDS} seeds, and the columns show the run with the median number of correct matches. "
    '±: standard deviation of this number over the seeds. "Of the matchable": number of correct '
    "matches divided by that of matchable points; lowest: the smallest of these over the seeds. "
    "Unique: correct matches, where each point of the second image counts once. A seed that finds "
    "no trusted geometry has no matches, as in match_images. Corner error: median over the seeds "
    "that a homography guided. Seconds: median time of guided matching without finding keypoints."
)


def guided_sections(
    run: Run,
    options: BenchmarkOptions,
    truths: Mapping[str, Sequence[PlanarPair]],
    key: str,
    title: str,
) -> list[Section]:
    """Match image pairs by descriptors alone and by guided matching, and tabulate both.

    `truths` maps names of ground truths, for example "refined", to the same pairs in the same
    order, each with the homographies of this ground truth.
    """
    if "guided" not in options.protocols:
        return []
    features = (options.deepdetect_480(), *options.chance_baselines())
    pairs = {
        of_truth[0].name: dict(zip(truths, of_truth, strict=True))
        for of_truth in zip(*truths.values(), strict=True)
    }

    rows = run.rows("guided matches of ", features, pairs, partial(guided_row, run))
    tables = [
        Table(
            f"{key}_guided_{truth}",
            f"Matches by descriptors alone and guided, {truth} homographies",
            COLUMNS,
            [
                {"pair": pair, "method": feature.title, **row[truth]}
                for pair in pairs
                for feature in features
                for row in where(rows, item=pair, method=feature.name)
            ],
            NOTE,
        )
        for truth in truths
    ]
    text = (
        "By descriptors alone: the paper's matching (SIFT of size 3, FLANN, ratio 0.99). Guided: "
        "guided matching, the default of `match_images`; the true homography is only used for "
        "evaluation. "
        f"DeepDetect gets {options.channels.upper()} images resized to 480x480."
    )
    return [Section(f"{title}, descriptors alone and guided", (text,), tables)]


def guided_row(run: Run, feature: LocalFeature, by_truth: Mapping[str, PlanarPair]) -> Row:
    """Match an image pair; return the cells of `COLUMNS` for each ground truth, by its name."""
    pair = next(iter(by_truth.values()))
    images = (pair.first, pair.second)
    alone = run.matches(feature, images, PAPER_MATCHING)
    sizes = [run.keypoints(feature, image)[0].image_size for image in images]
    guided = [match_guided(run, feature, pair, seed) for seed in range(SEEDS)]
    cells: Row = {}
    for truth, one in by_truth.items():
        places = transform_points(alone.keypoints0, one.homography)
        gaps = nearest_keypoints(places, alone.keypoints1, sizes[1])[1]
        matchable = int(np.count_nonzero(gaps < CORRECT_PX))
        correct = _correct(alone.points0, alone.points1, one)
        cells[truth] = {
            "matchable": matchable,
            "descriptors alone: correct": int(correct.sum()),
            "descriptors alone: precision": float(correct.mean()) if len(correct) else None,
            **_guided_cells(guided, one, matchable, sizes[0]),
        }
    return cells


def _guided_cells(
    guided: Sequence[Row], pair: PlanarPair, matchable: int, size: tuple[int, int]
) -> Row:
    correct = [_correct(found["points0"], found["points1"], pair) for found in guided]
    counts = [int(one.sum()) for one in correct]
    middle = int(np.argsort(counts, kind="stable")[(len(counts) - 1) // 2])
    unique = np.unique(guided[middle]["points1"][correct[middle]], axis=0)
    planes = [found["matrix"] for found in guided if found["model"] == "homography"]
    corners = [corner_error(matrix, pair.homography, size) for matrix in planes]
    return {
        "guided by": guided_by([found["model"] for found in guided]),
        "guided: correct": counts[middle],
        "± of correct": float(np.std(counts, ddof=1)),
        "guided: precision": float(correct[middle].mean()) if len(correct[middle]) else None,
        "guided: of the matchable": counts[middle] / matchable if matchable else None,
        "lowest": min(counts) / matchable if matchable else None,
        "guided: unique": len(unique),
        "guided: corner error, px": float(np.median(corners)) if corners else None,
        "guided: seconds": float(np.median([found["seconds"] for found in guided])),
    }


def guided_by(models: Sequence[str]) -> str:
    """Name the models that guided matching, and the number of guided seeds if some were not."""
    trusted = [model for model in models if model != "none"]
    names = " or ".join(dict.fromkeys(trusted)) or "none"
    if len(trusted) in (0, len(models)):
        return names
    return f"{names}, {len(trusted)} of {len(models)} seeds guided"


def _correct(points0: np.ndarray, points1: np.ndarray, pair: PlanarPair) -> np.ndarray:
    return transfer_errors(points0, points1, pair.homography) < CORRECT_PX


def match_guided(run: Run, feature: LocalFeature, pair: PlanarPair, seed: int) -> Row:
    """Match a pair by guided matching, or read the result from the cache.

    The pair's true homography is not used. Returns the "model" of the geometry that guided the
    matching ("none" if there are no matches), its "matrix", the matched positions "points0" and
    "points1", (M, 2) each, and the "seconds" of guided matching, without finding keypoints.
    """
    images = (pair.first, pair.second)
    first, second = (run.keypoints(feature, image)[0] for image in images)

    def make() -> Row:
        grays = luma(load_image(pair.first)), luma(load_image(pair.second))
        with profiled() as profile:
            trusted, found = Explanation(ImagePair(grays), (first, second), seed=seed).answer()
        return {
            "model": trusted.model,
            "matrix": np.empty((0, 3)) if trusted.matrix is None else trusted.matrix,
            "points0": np.empty((0, 2)) if found is None else found.starts(np.rint(first.xy)),
            "points1": np.empty((0, 2)) if found is None else found.points1,
            "seconds": profile.seconds,
        }

    return run.cached("guided", (feature.detection, images, seed), make)
