"""What variants of the ONNX file cost and give: precisions, runtimes, keypoints.

    python benchmarks/onnx_variants.py SAMPLES [IMAGES] [--weights default] [--rounds 21]

The tables of docs/other-programs.md. SAMPLES holds `image_NAME.png` and `mask_image_NAME.png`; int8
is calibrated on photographs of IMAGES, and left out without them. Bfloat16 and rows of OpenVINO are
left out where they cannot be run. Time is processor time of one thread at 480x640 pixels, beside
fp32 in the same runtime: the median ratio of rounds in which both run; `--rounds 0` leaves it out.
"""

from __future__ import annotations

import argparse
import importlib.util
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from deepdetect import DeepDetect, MissingExtraError, OptionError
from deepdetect.detector.backends.onnx_parts import cut_onnx
from deepdetect.detector.backends.without_telemetry import import_onnxruntime, import_openvino
from deepdetect.detector.network.onnx_graph import (
    IMAGE,
    LOGITS,
    PADDED_IMAGE,
    PADDED_LOGITS,
    PROBABILITY,
    STRIDE,
)
from deepdetect.detector.network.onnx_keypoints import KEYPOINT_LOGITS, KEYPOINTS, MAX_KEYPOINTS
from deepdetect.detector.network.onnx_variants import OnnxOptions, write_onnx
from deepdetect.evaluation.protocols.masks import sample_images, score_samples
from deepdetect.evaluation.report import Cell, Column, Table
from deepdetect.io.image import find_images, load_image

TIMED_SIZE = (480, 640)
PARITY_SIZES = ((480, 640, 1), (500, 741, 1), (481, 333, 1), (17, 23, 1), (64, 96, 2), (120, 43, 2))
"""Heights, widths and batches: multiples of the stride, and none."""

Precision = Literal["float32", "bfloat16"]
Maps = Callable[[np.ndarray], Sequence[np.ndarray]]
"""Maps (B, 3, H, W) float32 in [0, 1] to logits and probabilities, (B, 1, H, W), or to others."""

MAPS = (LOGITS, PROBABILITY)
ALL_OUTPUTS = (*MAPS, KEYPOINTS, KEYPOINT_LOGITS)
KEYPOINT_COUNTS = (100, MAX_KEYPOINTS, 10_000)

SAME_PX = 1e-3
"""Of a keypoint from the package's, where they count as the same."""


def main() -> None:
    """Export the variants to a temporary folder, and print the tables."""
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
        print(precision_table(files, samples, arguments.rounds).to_markdown() + "\n")
        image = load_image(samples[0])
        print(parity_table(files["fp32"], folder, image).to_markdown() + "\n")
        print(keypoint_table(files["fp32"], folder, samples, arguments.rounds).to_markdown())


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
    rows: list[tuple[Cell, ...]] = []
    marks: dict[str, list[np.ndarray]] = {}
    for name, detector in detectors.items():
        marks[name] = []

        def heatmap(rgb: np.ndarray, here: DeepDetect = detector, of: str = name) -> np.ndarray:
            found, logits = here.heatmap_and_logits(rgb)
            marks[of].append(logits > 0)
            return found

        scores = score_samples(heatmap, samples)
        texts = [f"{scores[kind][0].loss:.4f} / {scores[kind][0].iou:.3f}" for kind in scores]
        pairs = zip(marks[first], marks[name], strict=True)
        crossing = float(np.mean([np.mean(before != after) for before, after in pairs]))
        runs = (references[name].heatmap, detector.heatmap)
        ratio = 1.0 if name == first else time_ratio(*runs, timed, rounds)
        rows.append((name, rivals[name][0].stat().st_size / 1e6, *texts, crossing, ratio))
    kinds = (Column(f"{kind}: BCE / IoU") for kind in scores)
    columns = (Column("precision"), Column("MB", ".2f"), *kinds)
    columns += (Column("pixels that cross", ".3%"), Column("time", ".2f"))
    return Table("precision", "Precision", columns, tuple(rows))


def one_thread(path: Path, backend: str, precision: Precision = "float32") -> DeepDetect:
    """Open a file for images as they are."""
    return DeepDetect(path, backend=backend, precision=precision, threads=1, resolution="native")


def parity_table(path: Path, folder: Path, image: np.ndarray) -> Table:
    """Compare runtimes with the network run alone by ONNX Runtime."""
    alone = onnxruntime_session(cut_onnx(path.read_bytes(), [PADDED_IMAGE], [PADDED_LOGITS]))
    given, exact = [], []
    for height, width, batch in PARITY_SIZES:
        planes = planes_of(image, height, width, batch)
        sides = ((0, 0), (0, 0), (0, -height % STRIDE), (0, -width % STRIDE))
        padded = np.pad(planes, sides, mode="edge")
        logits = alone.run([PADDED_LOGITS], {PADDED_IMAGE: padded})[0][:, :, :height, :width]
        given.append(planes)
        exact.append((logits, 1 / (1 + np.exp(-logits.astype(float)))))
    rows: list[tuple[Cell, ...]] = []
    for name, runs in runtimes(path, folder):
        found = [run(planes) for run, planes in zip(runs, given, strict=True)]
        pairs = [zip(*both, strict=True) for both in zip(found, exact, strict=True)]
        gaps = [[float(np.abs(a - b).max()) for a, b in pair] for pair in pairs]
        rows.append((name, *map(float, np.max(gaps, 0))))
    columns = (Column("runtime"), Column("logits", ".0e"), Column("probability", ".0e"))
    return Table("parity", "Parity", columns, tuple(rows))


def runtimes(path: Path, folder: Path) -> Iterator[tuple[str, list[Maps]]]:
    """Yield what is installed, with a runtime for each of `PARITY_SIZES`."""
    count = len(PARITY_SIZES)
    yield "ONNX Runtime, any size", [in_onnxruntime(path)] * count
    if importlib.util.find_spec("openvino") is not None:
        yield "OpenVINO, any size", [in_openvino(path)] * count
    opencv = f"OpenCV {cv2.__version__}"
    engines: dict[str, tuple[int, ...]] = {"": ()}
    if cv2.__version__ >= "5":
        yield f"{opencv}, new engine, any size", [in_opencv(path, cv2.dnn.ENGINE_NEW)] * count
        engines = {", classic engine": (cv2.dnn.ENGINE_CLASSIC,)}
    for name, engine in engines.items():
        runs = []
        for height, width, batch in PARITY_SIZES:
            fixed = folder / f"{height}x{width}x{batch}.onnx"
            write_onnx(path, fixed, OnnxOptions((height, width), batch))
            runs.append(in_opencv(fixed, *engine))
        yield f"{opencv}{name}, one size", runs


def keypoint_table(path: Path, folder: Path, samples: list[Path], rounds: int) -> Table:
    """Compare files that give keypoints with the package, and their time with a file of maps."""
    makers: dict[str, Callable[[Path, Sequence[str]], Maps]] = {"ONNX Runtime": in_onnxruntime}
    if importlib.util.find_spec("openvino") is not None:
        makers["OpenVINO"] = in_openvino
    if cv2.__version__ >= "5":
        makers[f"OpenCV {cv2.__version__}"] = lambda file, names: in_opencv(
            file, cv2.dnn.ENGINE_NEW, names=names
        )
    images = [load_image(sample) for sample in samples]
    timed = planes_of(images[0], *TIMED_SIZE, 1)
    detector = one_thread(path, "onnxruntime")
    rows: list[tuple[Cell, ...]] = []
    for count in KEYPOINT_COUNTS:
        file = folder / f"keypoints-{count}.onnx"
        write_onnx(path, file, OnnxOptions(max_keypoints=count))
        expected = [
            detector.detect(image, max_keypoints=count, nms_radius=1, subpixel=True).xy
            for image in images
        ]
        for name, make in makers.items():
            run = make(file, ALL_OUTPUTS)
            found = [run(planes_of(image, *image.shape[:2], 1))[2][0] for image in images]
            pairs = zip(found, expected, strict=True)
            same = np.concatenate([are_near(xy, keypoints) for xy, keypoints in pairs])
            ratio = time_ratio(make(path, MAPS), run, timed, rounds)
            rows.append((name, count, float(np.mean(same)), ratio))
        if count == MAX_KEYPOINTS:
            unread = time_ratio(in_onnxruntime(path), in_onnxruntime(file), timed, rounds)
            rows.append(("ONNX Runtime, asked for maps", count, float("nan"), unread))
    columns = (Column("runtime"), Column("keypoints", ","), Column("the package's", ".4%"))
    return Table("keypoints", "Keypoints", (*columns, Column("time", ".3f")), tuple(rows))


def are_near(found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Return which of the expected positions are found, as rows of the file in any order."""
    if not len(expected):
        return np.empty(0, bool)
    squared = cv2.batchDistance(expected, found, cv2.CV_32F, normType=cv2.NORM_L2SQR, K=1)[0]
    return squared[:, 0] < SAME_PX**2


def onnxruntime_session(model: Path | bytes) -> Any:
    """Open a file, or the content of one, on one thread."""
    onnxruntime = import_onnxruntime()
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads, settings.log_severity_level = 1, 4
    given = model if isinstance(model, bytes) else str(model)
    return onnxruntime.InferenceSession(given, settings, providers=["CPUExecutionProvider"])


def in_onnxruntime(path: Path, names: Sequence[str] = MAPS) -> Maps:
    """Open a file in ONNX Runtime."""
    session = onnxruntime_session(path)
    return lambda planes: session.run(names, {IMAGE: planes})


def in_openvino(path: Path, names: Sequence[str] = MAPS) -> Maps:
    """Open a file in OpenVINO, in float32."""
    settings = {"INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": 1}
    model = import_openvino().Core().compile_model(str(path), "CPU", settings)

    def run(planes: np.ndarray) -> list[np.ndarray]:
        found = model([planes])
        return [found[name].copy() for name in names]

    return run


def in_opencv(path: Path, *engine: int, names: Sequence[str] = MAPS) -> Maps:
    """Open a file in OpenCV, in version 5 by one of its engines; all outputs must be named."""
    network = cv2.dnn.readNetFromONNX(str(path), *engine)

    def run(planes: np.ndarray) -> Sequence[np.ndarray]:
        network.setInput(planes)
        return network.forward(names)

    return run


def planes_of(rgb: np.ndarray, height: int, width: int, batch: int) -> np.ndarray:
    """Return an image in this size, and turned upside down in each other place of the batch."""
    one = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_CUBIC)
    images = np.stack([one[::-1] if k % 2 else one for k in range(batch)])
    return np.ascontiguousarray(images.transpose(0, 3, 1, 2) * np.float32(1 / 255))


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
