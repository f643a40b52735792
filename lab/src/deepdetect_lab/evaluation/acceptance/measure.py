"""Measure how well a matching engine answers image pairs whose true geometry is known."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from deepdetect import DeepDetect, Matches, match_images
from deepdetect._shared.errors import ImageError
from deepdetect._shared.opencv import cv2
from deepdetect._shared.progress import progress

from ..metrics.homography import area_under_curve
from ..protocols.pose import GOOD_DEG
from ..report import Row, Rows, Table, mean_of
from . import photographs, synthetic
from .pairs import JudgedPair

FAMILIES: dict[str, Callable[[Path], Iterator[JudgedPair]]] = {
    maker.__name__.replace("_", "-"): maker
    for maker in (
        *(photographs.oxford, photographs.middlebury, photographs.posed, photographs.wide),
        *(photographs.webcams, photographs.exposures, photographs.unrelated),
        *(synthetic.planes, synthetic.facades, synthetic.hard_views, synthetic.overlays),
        *(synthetic.frames, synthetic.strips, synthetic.noise),
    )
}
"""Functions that yield the pairs of a family (a data set or a kind of rendering), by name."""

ORDERS, F_THRESHOLD_PX, F_CONFIDENCE, F_ITERATIONS, ACCURACY_PX = 11, 1.5, 0.9999, 10_000, 10
"""MAGSAC estimates F from the matches in `ORDERS` random orders, because its result depends on the
order. Published values of the mAA (mean average accuracy) use the same threshold in pixels,
confidence and number of iterations. The mAA is the fraction of hand-marked correspondences whose
points are within d px of their epipolar lines in both images, averaged over d = 1, 2, ...,
`ACCURACY_PX`."""

COLUMNS = {
    **{"kind": "", "answers": ",d", "right": ",d", "wrong, high": ",d", "wrong, fair": ",d"},
    **{"lost": ",d", "matches": ",.0f", "precision": ".3f", f"AUC at {GOOD_DEG:g}°": ".3f"},
    **{"mAA at 10 px": ".3f", "± of right": ".1f", "CPU s": ".2f"},
}

NOTE = (
    "Right: at least half of the matches are correct, or their pose is; high and fair are the "
    "confidences of wrong answers; lost: no matches. Matches: median number of matches of an "
    "answer; precision: mean fraction of correct matches. AUC: area under the curve of the pose "
    "errors. mAA: fraction of the hand-marked points near MAGSAC's epipolar lines, mean over "
    f"{ORDERS} orders of the matches. ±: standard deviation over the seeds of the number of right "
    "answers. CPU s: median processor time of a pair."
)

Engine = Callable[..., Matches]
"""A matching method to test: a function of two (H, W, 3) uint8 RGB images and keyword `seed`."""


def guided() -> Engine:
    """Return `match_images` with one network for all pairs."""
    detector = DeepDetect()
    return lambda image0, image1, seed: match_images(image0, image1, detector, seed=seed)


def measure(
    data: Path,
    engine: Engine,
    log: Path,
    *,
    families: Sequence[str] = tuple(FAMILIES),
    seeds: int = 5,
    every: int = 1,
    quiet: bool = True,
) -> Rows:
    """Run an engine on all pairs with all seeds; return a row for each answer.

    Answers are appended to the file `log`, one JSON object per line. A second call with the same
    file only computes the missing answers.

    Args:
        data: folder of the data sets.
        engine: function of two images and a seed.
        log: file of the answers.
        families: names of families of pairs.
        seeds: number of seeds.
        every: answer only every Nth pair of a family.
        quiet: show no progress bars.

    Raises:
        ImageError: the data folder has none of the families' pairs.
    """
    rows: Rows = []
    with suppress(FileNotFoundError):
        rows = [json.loads(line) for line in log.read_text().splitlines()]
    done = {(row["kind"], row["pair"], row["seed"]) for row in rows}
    wanted = set()
    log.parent.mkdir(parents=True, exist_ok=True)
    for family in families:
        pairs = list(_pairs(data, family, every))
        with (
            progress(len(pairs) * seeds, family, "answer", quiet=quiet) as bar,
            log.open("a") as file,
        ):
            for pair in pairs:
                for seed in range(seeds):
                    name = (pair.kind, pair.name, seed)
                    wanted.add(name)
                    if name not in done:
                        rows.append(answer(pair, engine, seed))
                        file.write(json.dumps(rows[-1]) + "\n")
                        file.flush()
                    bar.update(1)
    if not wanted:
        raise ImageError(
            f"{data} has no pairs of {', '.join(families)}: give a folder of benchmarks"
        )
    return [row for row in rows if (row["kind"], row["pair"], row["seed"]) in wanted]


def _pairs(data: Path, family: str, every: int) -> Iterator[JudgedPair]:
    with suppress(ImageError):  # the folder lacks the photographs of this family
        yield from islice(FAMILIES[family](data), 0, None, every)


def answer(pair: JudgedPair, engine: Engine, seed: int) -> Row:
    """Run an engine on a pair; return a row with its answer and whether the answer is right."""
    images, started = pair.make(), time.process_time()
    matches = engine(*images, seed=seed)
    seconds = time.process_time() - started
    geometry = matches.geometry
    correct = pair.truth.correct(matches.points0, matches.points1)
    error = pair.truth.pose_error(matches.points0, matches.points1)
    marked = pair.correspondences
    return {
        "kind": pair.kind,
        "pair": pair.name,
        "seed": seed,
        "answer": pair.truth.judge(matches),
        "confidence": "none" if geometry is None else geometry.confidence,
        "model": "none" if geometry is None else geometry.model,
        "scene": "none" if geometry is None else geometry.scene,
        "matches": len(matches),
        "precision": float(correct.mean()) if len(correct) else None,
        "pose error": None if error is None else min(error, 180.0),  # infinite without a pose
        "accuracy": None if marked is None else _accuracy(matches, marked),
        "seconds": seconds,
    }


def _accuracy(matches: Matches, places: np.ndarray) -> float:
    points0, points1 = (np.asarray(p, np.float64) for p in (matches.points0, matches.points1))
    found = []
    for order in range(ORDERS):
        chosen = np.random.default_rng(order).permutation(len(points0))
        matrix = None
        if len(chosen) >= 8:
            limits = F_THRESHOLD_PX, F_CONFIDENCE, F_ITERATIONS
            with suppress(cv2.error):  # OpenCV fails on some orders only
                matrix, _ = cv2.findFundamentalMat(
                    points0[chosen], points1[chosen], cv2.USAC_MAGSAC, *limits
                )
        if matrix is None or matrix.shape != (3, 3):
            found.append(0.0)
            continue
        errors = _both_lines(matrix, places)
        found.append(
            float(np.mean([(errors < limit).mean() for limit in range(1, ACCURACY_PX + 1)]))
        )
    return float(np.mean(found))


def _both_lines(matrix: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return the larger of each correspondence's two distances from epipolar lines, (K,) pixels."""
    first, second = (np.column_stack([p, np.ones(len(p))]) for p in (places[:, :2], places[:, 2:]))
    lines1, lines0 = first @ matrix.T, second @ matrix
    residuals = np.abs((second * lines1).sum(axis=1))
    lengths = [np.hypot(*lines.T[:2]) for lines in (lines0, lines1)]
    return np.asarray(residuals / np.minimum(*lengths))


def summary(rows: Rows) -> Table:
    """Return a table with a line for each kind of pair, and a last line for all pairs."""
    kinds: dict[str, Rows] = {}
    for row in rows:
        kinds.setdefault(row["kind"], []).append(row)
    lines: list[dict[str, Any]] = [_line(kind, own) for kind, own in kinds.items()]
    return Table("acceptance", "Answers by kind", COLUMNS, [*lines, _line("all", rows)], NOTE)


def _line(kind: str, rows: Rows) -> Row:
    answered = [row for row in rows if row["answer"] != "lost"]
    wrong = [row["confidence"] for row in rows if row["answer"] == "wrong"]
    errors = [row["pose error"] for row in rows if row["pose error"] is not None]
    by_seed: dict[int, int] = {}
    for row in rows:
        by_seed[row["seed"]] = by_seed.get(row["seed"], 0) + (row["answer"] == "right")
    return {
        "kind": kind,
        "answers": len(rows),
        "right": sum(by_seed.values()),
        "wrong, high": wrong.count("high"),
        "wrong, fair": len(wrong) - wrong.count("high"),
        "lost": len(rows) - len(answered),
        "matches": float(np.median([row["matches"] for row in answered])) if answered else None,
        "precision": mean_of(row["precision"] for row in answered),
        f"AUC at {GOOD_DEG:g}°": area_under_curve(errors, GOOD_DEG) if errors else None,
        "mAA at 10 px": mean_of(row["accuracy"] for row in rows),
        "± of right": float(np.std([*by_seed.values()])),
        "CPU s": float(np.median([row["seconds"] for row in rows])),
    }
