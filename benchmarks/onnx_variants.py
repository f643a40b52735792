"""What the precisions of the ONNX file cost and give.

    python benchmarks/onnx_variants.py SAMPLES [IMAGES] [--weights default] [--rounds 21]

The table of docs/other-programs.md. SAMPLES holds `image_NAME.png` and `mask_image_NAME.png`; int8
is calibrated on images of IMAGES, and left out without them. Bfloat16 and rows of OpenVINO are
left out where they cannot be run. Time is processor time of one thread at 480x640 pixels, beside
fp32 in the same runtime: the median ratio of rounds in which both run; `--rounds 0` leaves it out.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from deepdetect import DeepDetect, MissingExtraError, OptionError
from deepdetect.detector.network.onnx_export import OnnxOptions, write_onnx
from deepdetect.evaluation.protocols.masks import load_sample, sample_images, score_samples
from deepdetect.evaluation.report import Row, Table
from deepdetect.io.image import find_images, load_image

TIMED_SIZE = (480, 640)

Precision = Literal["float32", "bfloat16"]


def main() -> None:
    """Export the variants to a temporary folder, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("samples", type=Path)
    parser.add_argument("images", type=Path, nargs="?", help="that calibrate int8")
    parser.add_argument("--weights", default="default")
    parser.add_argument("--rounds", type=int, default=21, help="of the timing (default 21)")
    arguments = parser.parse_args()
    samples = sample_images(arguments.samples)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files = {"fp32": folder / "fp32.onnx", "fp16": folder / "fp16.onnx"}
        write_onnx(arguments.weights, files["fp32"], OnnxOptions(max_keypoints=0))
        write_onnx(arguments.weights, files["fp16"], OnnxOptions(precision="fp16", max_keypoints=0))
        if arguments.images is not None:
            files["int8"] = folder / "int8.onnx"
            images = find_images(arguments.images)
            options = OnnxOptions(precision="int8", max_keypoints=0)
            write_onnx(arguments.weights, files["int8"], options, calibration=images)
        print(precision_table(files, samples, arguments.rounds).to_markdown())


def precision_table(files: Mapping[str, Path], samples: list[Path], rounds: int) -> Table:
    """Score each file on the samples, and bfloat16 where it can be run, beside the first file."""
    rivals: dict[str, tuple[Path, str, Precision]] = {
        name: (path, "onnxruntime", "float32") for name, path in files.items()
    }
    first = next(iter(files))
    rivals["bfloat16"] = (files[first], "openvino", "bfloat16")
    detectors, references = {}, {}
    for name, (path, backend, precision) in rivals.items():
        try:
            detectors[name] = one_thread(path, backend, precision)
            references[name] = one_thread(files[first], backend)
        except (MissingExtraError, OptionError):
            continue
    timed = cv2.resize(load_image(samples[0]), TIMED_SIZE[::-1], interpolation=cv2.INTER_CUBIC)
    rows: list[Row] = []
    marks: dict[str, list[np.ndarray]] = {}
    for name, detector in detectors.items():
        marks[name] = []

        def heatmap(rgb: np.ndarray, here: DeepDetect = detector, of: str = name) -> np.ndarray:
            found, logits = here.heatmap_and_logits(rgb)
            marks[of].append(logits > 0)
            return found

        scores = score_samples(heatmap, map(load_sample, samples))
        texts = {f"{kind}: BCE / IoU": f"{s.loss:.4f} / {s.iou:.3f}" for kind, s in scores.items()}
        pairs = zip(marks[first], marks[name], strict=True)
        crossing = float(np.mean([np.mean(before != after) for before, after in pairs]))
        runs = (references[name].heatmap, detector.heatmap)
        ratio = 1.0 if name == first else time_ratio(*runs, timed, rounds)
        size = rivals[name][0].stat().st_size / 1e6
        rows.append({"precision": name, "MB": size, **texts})
        rows[-1] |= {"pixels that cross": crossing, "time": ratio}
    columns = {"precision": "", "MB": ".2f", **dict.fromkeys(texts, "")}
    columns |= {"pixels that cross": ".3%", "time": ".2f"}
    return Table("precision", "Precision", columns, rows)


def one_thread(path: Path, backend: str, precision: Precision = "float32") -> DeepDetect:
    """Open a file for images as they are."""
    return DeepDetect(path, backend=backend, precision=precision, threads=1, resolution="native")


def time_ratio(
    first: Callable[[np.ndarray], Any],
    second: Callable[[np.ndarray], Any],
    image: np.ndarray,
    rounds: int,
) -> float:
    """Return the processor time of the second in that of the first, the median; NaN of 0 rounds."""
    ratios = []
    for turn in range(rounds + 1):  # the first one warms up
        seconds = []
        for run in (first, second)[:: -1 if turn % 2 else 1]:
            started = time.process_time()
            run(image)
            seconds.append(time.process_time() - started)
        before, after = seconds[:: -1 if turn % 2 else 1]
        ratios.append(after / before)
    return float(np.median(ratios[1:])) if rounds else float("nan")


if __name__ == "__main__":
    main()
