"""Time guided matching of two versions of this package side by side.

    python benchmarks/compare_versions.py OLD NEW --oxford OXFORD [--repeats 5] [--max-keypoints N]
        [--lost]

OLD and NEW are the `src` folders of two checkouts (`git worktree add ../old COMMIT`); both run with
the packages that are installed now. Each pair is matched by both in turns, `match_images` with its
defaults, in one process for each version, after one pair that compiles and loads. Printed are the
medians of wall and CPU seconds, the numbers of matches and the ratio old over new. With --lost
pairs of different scenes follow, which have nothing to match.
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

SCENES = ("graf", "wall", "bikes", "leuven", "trees", "ubc", "boat", "bark")
PAIRS = (
    *(("graf", 6), ("wall", 6), ("bikes", 6), ("leuven", 6), ("trees", 6), ("ubc", 6)),
    *(("boat", 2), ("boat", 6), ("bark", 6)),
)


LOST_PAIRS = tuple(zip(SCENES, (*SCENES[1:], SCENES[0]), strict=True))
"""Each scene with the next one."""


def main() -> None:
    """Print a row for each pair, and the geometric mean of the ratios."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("sources", type=Path, nargs=2, metavar=("OLD", "NEW"))
    parser.add_argument("--oxford", type=Path, required=True)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--max-keypoints", type=int, help="of both versions")
    parser.add_argument("--new-max-keypoints", type=int, help="of the new version alone")
    parser.add_argument("--lost", action="store_true", help="pairs of different scenes, too")
    args = parser.parse_args()
    few = [args.max_keypoints, args.new_max_keypoints or args.max_keypoints]
    options = [{} if count is None else {"max_keypoints": count} for count in few]
    workers = [_start(source) for source in args.sources]
    for worker, chosen in zip(workers, options, strict=True):
        _match(worker, _images(args.oxford, "ubc", 2), chosen)
    print("| pair | old: wall, CPU s, matches | new | ratio wall, CPU |\n|---|---|---|---|")
    guided = [(f"{scene} 1-{n}", _images(args.oxford, scene, n)) for scene, n in PAIRS]
    _compare(workers, options, guided, args.repeats)
    if args.lost:
        lost = [
            (f"{one} - {other}", (_image(args.oxford, one, 1), _image(args.oxford, other, 1)))
            for one, other in LOST_PAIRS
        ]
        _compare(workers, options, lost, args.repeats)
    for worker in workers:
        worker.kill()


def _compare(
    workers: Sequence[subprocess.Popen[str]],
    options: Sequence[dict[str, int]],
    pairs: Sequence[tuple[str, tuple[str, str]]],
    repeats: int,
) -> None:
    """Print a row for each pair, the medians over the pairs, and the mean of the ratios."""
    ratios, all_medians = [], []
    for name, images in pairs:
        runs: list[list[Sequence[float]]] = [[], []]
        for _ in range(repeats):
            for worker, chosen, own in zip(workers, options, runs, strict=True):
                own.append(_match(worker, images, chosen))
        medians = [[statistics.median(values) for values in zip(*own, strict=True)] for own in runs]
        ratios.append([medians[0][column] / medians[1][column] for column in (0, 1)])
        all_medians.append(medians)
        print(f"| {name} | {' | '.join(map(_cell, medians))} | {_pair(ratios[-1])} |", flush=True)
    middle = [
        [statistics.median(values) for values in zip(*own, strict=True)]
        for own in zip(*all_medians, strict=True)
    ]
    means = [statistics.geometric_mean(column) for column in zip(*ratios, strict=True)]
    print(f"| median; geometric mean | {' | '.join(map(_cell, middle))} | {_pair(means)} |")


def _cell(values: Sequence[float]) -> str:
    wall, cpu, count = values
    return f"{wall:.2f}, {cpu:.2f}, {count:,.0f}"


def _images(oxford: Path, scene: str, number: int) -> tuple[str, str]:
    return _image(oxford, scene, 1), _image(oxford, scene, number)


def _image(oxford: Path, scene: str, number: int) -> str:
    return str(oxford / scene / f"img{number}.png")


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
