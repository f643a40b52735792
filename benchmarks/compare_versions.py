"""Time guided matching of two versions of this package side by side.

    python benchmarks/compare_versions.py OLD NEW --oxford OXFORD [--repeats 5] [--max-keypoints N]

OLD and NEW are the `src` folders of two checkouts (`git worktree add ../old COMMIT`); both run with
the packages that are installed now. Each pair is matched by both in turns, `match_images` with its
defaults, in one process for each version, after one pair that compiles and loads. Printed are the
medians of wall and CPU seconds, the numbers of matches and the ratio old over new.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

WORKER = """
import json, sys, time
from deepdetect import DeepDetect, match_images
detector = DeepDetect()
for line in sys.stdin:
    first, second, options = json.loads(line)
    wall, cpu = time.perf_counter(), time.process_time()
    found = match_images(first, second, detector, **options)
    seconds = time.perf_counter() - wall, time.process_time() - cpu
    print(json.dumps([*seconds, len(found)]), flush=True)
"""

PAIRS = (
    *(("graf", 6), ("wall", 6), ("bikes", 6), ("leuven", 6), ("trees", 6), ("ubc", 6)),
    *(("boat", 2), ("boat", 6), ("bark", 6)),
)


def main() -> None:
    """Print a row for each pair, and the geometric mean of the ratios."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("sources", type=Path, nargs=2, metavar=("OLD", "NEW"))
    parser.add_argument("--oxford", type=Path, required=True)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--max-keypoints", type=int, help="of both versions")
    parser.add_argument("--new-max-keypoints", type=int, help="of the new version alone")
    args = parser.parse_args()
    few = [args.max_keypoints, args.new_max_keypoints or args.max_keypoints]
    options = [{} if count is None else {"max_keypoints": count} for count in few]
    workers = [_start(source) for source in args.sources]
    for worker, chosen in zip(workers, options, strict=True):
        _match(worker, _images(args.oxford, "ubc", 2), chosen)
    print("| pair | old: wall, CPU s, matches | new | ratio wall, CPU |\n|---|---|---|---|")
    ratios = []
    for scene, number in PAIRS:
        images = _images(args.oxford, scene, number)
        runs: list[list[Sequence[float]]] = [[], []]
        for _ in range(args.repeats):
            for worker, chosen, own in zip(workers, options, runs, strict=True):
                own.append(_match(worker, images, chosen))
        medians = [[statistics.median(values) for values in zip(*own, strict=True)] for own in runs]
        ratios.append([medians[0][column] / medians[1][column] for column in (0, 1)])
        cells = [f"{wall:.2f}, {cpu:.2f}, {count:,.0f}" for wall, cpu, count in medians]
        print(f"| {scene} 1-{number} | {' | '.join(cells)} | {_pair(ratios[-1])} |", flush=True)
    means = [statistics.geometric_mean(column) for column in zip(*ratios, strict=True)]
    print(f"| geometric mean | | | {_pair(means)} |")
    for worker in workers:
        worker.kill()


def _images(oxford: Path, scene: str, number: int) -> tuple[str, str]:
    first, second = (str(oxford / scene / f"img{one}.png") for one in (1, number))
    return first, second


def _pair(values: Sequence[float]) -> str:
    return f"{values[0]:.2f}, {values[1]:.2f}"


def _start(source: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", WORKER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(source.resolve())},
    )


def _match(
    worker: subprocess.Popen[str], images: tuple[str, str], options: dict[str, int]
) -> Sequence[float]:
    assert worker.stdin is not None
    assert worker.stdout is not None
    worker.stdin.write(json.dumps([*images, options]) + "\n")
    worker.stdin.flush()
    line = worker.stdout.readline()
    if not line:
        raise SystemExit("a version ended with an error: see above")
    found: Sequence[float] = json.loads(line)
    return found


if __name__ == "__main__":
    main()
