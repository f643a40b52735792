"""The network on batches, and on the same images one by one, in turn, on two threads.

    python benchmarks/batches.py

Why `DeepDetect.detect` shows the network one image of a list at a time.
"""

from __future__ import annotations

import time

import numpy as np

from deepdetect.detector.backends.without_telemetry import import_onnxruntime
from deepdetect.detector.pretrained import pretrained_weights
from deepdetect.evaluation.report import Cell, Column, Table

SIDES_PX = (64, 128, 240, 480)
BATCH = 8
ROUNDS = 9
THREADS = 2


def main() -> None:
    """Print the table."""
    table = batch_table()
    print(f"{table.to_markdown()}\n\n{table.note}")


def batch_table() -> Table:
    """Run random images of several sizes in both ways."""
    onnxruntime = import_onnxruntime()
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = THREADS
    session = onnxruntime.InferenceSession(
        str(pretrained_weights()), settings, providers=["CPUExecutionProvider"]
    )
    name, output = session.get_inputs()[0].name, session.get_outputs()[0].name

    def run(planes: np.ndarray) -> np.ndarray:
        return np.asarray(session.run([output], {name: planes})[0])

    rows: list[tuple[Cell, ...]] = []
    for side in SIDES_PX:
        batch = np.random.default_rng(0).random((BATCH, 3, side, side), np.float32)
        singles = [np.ascontiguousarray(batch[k : k + 1]) for k in range(BATCH)]
        seconds = np.empty((ROUNDS + 1, 2))
        for turn in range(ROUNDS + 1):
            start = time.perf_counter()
            one_by_one = np.concatenate([run(single) for single in singles])
            middle = time.perf_counter()
            together = run(batch)
            seconds[turn] = middle - start, time.perf_counter() - middle
        first, second = np.min(seconds[1:], axis=0)
        difference = float(np.abs(one_by_one - together).max())
        rows.append((side, 1e3 * first / BATCH, 1e3 * second / BATCH, first / second, difference))
    titles = (
        Column("side, px", "d"),
        Column("one by one, ms", ".1f"),
        Column(f"batch of {BATCH}, ms", ".1f"),
        Column("times faster", ".2f"),
        Column("largest difference", ".1e"),
    )
    note = f"Per image; the fastest of {ROUNDS} rounds after a first one, {THREADS} threads."
    return Table("batches", "The network on batches", titles, tuple(rows), note)


if __name__ == "__main__":
    main()
