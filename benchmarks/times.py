"""Measure time, repeatability and matches of many methods for keypoints with descriptors.

    python benchmarks/times.py DATA --cache FOLDER [--method xfeat.onnx --method edgepoint2.onnx]

Times are from an image of 800x600 in memory (the only size that XFeat's file takes) to at most
2,048 keypoints with descriptors. They are medians over rounds, in which all methods take turns, in
a process with one or two processors. SIFT and ORB with their own descriptors detect and describe in
one call. Repeatability and correct matches are means over the 40 pairs of Oxford, as in the
standard protocol, and are kept in the cache.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from deepdetect import DeepDetect, PointDetector, SelectionOptions
from deepdetect.io.image import load_image, luma
from deepdetect_lab.datasets.planar import load_oxford
from deepdetect_lab.evaluation.baselines.external import onnx_feature
from deepdetect_lab.evaluation.baselines.hessian import HESSIAN
from deepdetect_lab.evaluation.baselines.method import (
    LocalFeature,
    deepdetect_feature,
    points_feature,
    with_common_descriptor,
    with_own_scale,
)
from deepdetect_lab.evaluation.baselines.opencv import STANDARD
from deepdetect_lab.evaluation.protocols.planar import pairs_of
from deepdetect_lab.evaluation.protocols.standard import MATCHING_BUDGET, pair_row
from deepdetect_lab.evaluation.report import Row, Table, mean, where
from deepdetect_lab.evaluation.run import Run
from deepdetect_lab.labels.factories import opencv_factory

SIZE_PX = (800, 600)
ROUNDS = 15
"""Number of timed rounds. Chosen by hand."""

WEIGHTS = ("default", "espnet")
"""Weights of our networks that are measured."""

TOGETHER = {"SIFT": "SIFT_create", "ORB": "ORB_create"}
"""Methods of OpenCV that compute keypoints and their own descriptors in one call."""

RUNTIMES = {"openvino": "", "onnxruntime": ", ONNX Runtime"}
"""End of the columns' titles for each runtime."""

THREADS = {1: "1 thread", 2: "2 threads"}

MEASURES = {
    "keypoints": (("keypoints", MATCHING_BUDGET), ",.0f"),
    "@1": (("repeated", MATCHING_BUDGET, 1.0), ".3f"),
    "@3": (("repeated", MATCHING_BUDGET, 3.0), ".3f"),
    "right at 1 px": (("correct", 1), ",.0f"),
    "right at 3 px": (("correct", 3), ",.0f"),
}
"""Title of each column, with its key in the rows of the standard protocol and number format."""


def networks(files: Sequence[str], runtime: str, threads: int | None) -> list[LocalFeature]:
    """Return others' networks from files, and ours with the most probable pixels as keypoints."""
    selection = SelectionOptions(max_keypoints=MATCHING_BUDGET, nms_radius=1, subpixel=True)
    ours = []
    for weights in WEIGHTS:
        detector = DeepDetect(weights, backend=runtime, threads=threads, resolution="native")
        ours.append(
            deepdetect_feature(detector, selection, name=weights, title=f"dense, {weights}")
        )
    return described([*(onnx_feature(file, runtime, threads) for file in files), *ours])


def classical() -> list[LocalFeature]:
    """Return the methods that run neither in ONNX Runtime nor in OpenVINO."""
    detector = PointDetector(MATCHING_BUDGET, resolution="native")
    version = str(detector.settings)
    points = replace(points_feature(), detect=detector.detect, version=version, detection="")
    known = [STANDARD[name] for name in ("sift", "orb", "fast")]
    return described([*known, *HESSIAN.values(), replace(points, title="points")])


def described(features: Sequence[LocalFeature]) -> list[LocalFeature]:
    """Return each feature once with each of its descriptors, which are named in the titles."""
    rows = []
    for feature in features:
        if feature.learned or feature.title in TOGETHER:
            rows.append(replace(feature, name=f"{feature.name}-own", title=f"{feature.title}, own"))
        common = with_common_descriptor(feature)
        rows.append(replace(common, title=f"{feature.title}, RootSIFT"))
        if feature.own_scale:
            rows.append(with_own_scale(feature))
    return rows


def measure_times(photograph: Path, files: Sequence[str], threads: int) -> Row:
    """Return the milliseconds of each feature, by its title with the name of the runtime."""
    image = cv2.resize(load_image(photograph), SIZE_PX, interpolation=cv2.INTER_AREA)
    work = {feature.title: partial(extract, feature, image) for feature in classical()}
    for name, factory in TOGETHER.items():
        together = opencv_factory(factory)(MATCHING_BUDGET)
        work[f"{name}, own"] = lambda f=together: f.detectAndCompute(luma(image), None)
    for runtime, said in RUNTIMES.items():
        for feature in networks(files, runtime, threads):
            work[feature.title + said] = partial(extract, feature, image)
    milliseconds: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(ROUNDS):
        for name, function in work.items():
            function()  # compiles, fills the cache, and waits for threads of the previous method
            begin = time.perf_counter()
            function()
            milliseconds[name].append(1000 * (time.perf_counter() - begin))
    return {name: float(np.median(values)) for name, values in milliseconds.items()}


def extract(feature: LocalFeature, image: np.ndarray) -> np.ndarray:
    """Return the descriptors of the best keypoints."""
    return feature.describe(image, feature.detect(image).best(MATCHING_BUDGET))


def on_processors(count: int, function: Callable[..., Row], *arguments: object) -> Row:
    """Call a module-level function in a new process that may use only `count` processors."""
    all_of_them = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(all_of_them)[:count])
    context = multiprocessing.get_context("spawn")
    try:
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            return pool.submit(function, *arguments, count).result()
    finally:
        os.sched_setaffinity(0, all_of_them)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--method", action="append", default=[], help="an ONNX file")
    arguments = parser.parse_args()
    oxford = arguments.data / "oxford"
    pairs = {pair.name: pair for pair in pairs_of(load_oxford(oxford, "refined"))}
    run = Run(oxford, arguments.cache)
    features = [*classical(), *networks(arguments.method, "openvino", None)]
    measured = run.rows("", features, pairs, partial(pair_row, run))
    photograph = oxford / "graf" / "img1.png"
    times = {n: on_processors(n, measure_times, photograph, arguments.method) for n in (1, 2)}
    rows = []
    for feature in features:
        method, _, descriptors = feature.title.rpartition(", ")
        row: Row = {"method": method, "descriptors": descriptors}
        for said in RUNTIMES.values():
            for count, milliseconds in times.items():
                row[f"{THREADS[count]}{said}, ms"] = milliseconds.get(feature.title + said)
        own = where(measured, method=feature.name)
        rows.append(row | {title: mean(own, name) for title, (name, _) in MEASURES.items()})
    styles = {title: style for title, (_, style) in MEASURES.items()}
    heads = {title: styles.get(title, ".0f") for title in rows[0]} | {
        "method": "",
        "descriptors": "",
    }
    print(Table("times", "times", heads, rows).to_markdown())


if __name__ == "__main__":
    main()
