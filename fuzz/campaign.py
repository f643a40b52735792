"""A campaign: batches of inputs in child processes, and what came of them."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from tqdm import tqdm

from .case import DEFECTS, OUTCOMES, Target

ROOT = Path(__file__).parents[1]
CHILD = (sys.executable, "-m", "fuzz.child")
START_S = 120.0
"""Until the first input begins: packages are imported, and kernels compiled."""


@dataclass
class Findings:
    """What came of the inputs of a target.

    Attributes:
        counts: inputs by outcome.
        defects: number of the input, its outcome, and what was said.
    """

    counts: Counter[str] = field(default_factory=Counter)
    defects: list[tuple[int, str, str]] = field(default_factory=list)

    @property
    def tried(self) -> int:
        """All inputs."""
        return sum(self.counts.values())

    def add(self, number: int, outcome: str, reason: str) -> None:
        """Count an input."""
        self.counts[outcome] += 1
        if outcome in DEFECTS:
            self.defects.append((number, outcome, reason))


def run_campaign(
    targets: Iterable[Target],
    *,
    seed: int,
    share: float = 1.0,
    seconds: float | None = None,
    processes: int = 2,
) -> dict[str, Findings]:
    """Run the targets, each with its share of inputs.

    Args:
        targets: which.
        seed: of all inputs; the same seed gives the same inputs.
        share: of each target's `count`.
        seconds: no batch begins after them.
        processes: that run at once.

    Returns:
        What came of them, by name.
    """
    targets = list(targets)
    findings = {target.name: Findings() for target in targets}
    batches: list[tuple[float, Target, int, int]] = []
    for target in targets:
        count = max(1, round(target.count * share))
        for first in range(0, count, target.batch):
            last = min(first + target.batch, count)
            batches.append((last / count, target, first, last))
    # All targets advance alike, so that a campaign that is cut short has tried all of them.
    batches.sort(key=lambda batch: batch[0])
    stop = None if seconds is None else time.monotonic() + seconds
    total = sum(last - first for _, _, first, last in batches)
    lock = threading.Lock()
    with (
        tqdm(total=total, desc="inputs", unit="input") as bar,
        ThreadPoolExecutor(processes) as pool,
    ):

        def work(batch: tuple[float, Target, int, int]) -> None:
            _, target, first, last = batch
            if stop is not None and time.monotonic() > stop:
                return
            for number, outcome, reason in run_batch(target, seed, first, last):
                with lock:
                    findings[target.name].add(number, outcome, reason)
                    bar.update()

        list(pool.map(work, batches))
    return findings


def run_batch(target: Target, seed: int, first: int, last: int) -> Iterable[tuple[int, str, str]]:
    """Yield number, outcome and reason of each input; a process that dies is replaced."""
    while first < last:
        command = [*CHILD, target.name, *map(str, (seed, first, last))]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
        with subprocess.Popen(
            command,
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        ) as child:
            lines: queue.Queue[str | None] = queue.Queue()
            reader = threading.Thread(target=_read, args=(child, lines), daemon=True)
            reader.start()
            begun, limit = first - 1, START_S
            while True:
                try:
                    line = lines.get(timeout=limit)
                except queue.Empty:
                    child.kill()
                    child.wait()
                    begun = max(begun, first)
                    yield begun, "hang", f"more than {limit:g} s"
                    break
                if line is None:
                    if begun < last - 1 or child.wait() != 0:
                        begun = max(begun, first)
                        yield begun, "crash", f"exit code {child.wait()}"
                    break
                report = json.loads(line)
                if "begins" in report:
                    begun, limit = report["begins"], target.limit_s
                else:
                    yield report["ends"], report["outcome"], report["reason"]
                    first, begun = report["ends"] + 1, report["ends"]
            first = max(first, begun + 1)


def _read(child: subprocess.Popen[str], lines: queue.Queue[str | None]) -> None:
    assert child.stdout is not None
    for line in child.stdout:
        lines.put(line)
    lines.put(None)


def as_table(findings: Mapping[str, Findings], titles: Mapping[str, str]) -> str:
    """Return a table in Markdown."""
    lines = [
        "| what | tried | right or harmless | refused in a sentence | other exception | crash | "
        "hang | wrong in silence |",
        "|---|--:|--:|--:|--:|--:|--:|--:|",
    ]
    total: Counter[str] = Counter()
    for name, found in findings.items():
        total += found.counts
        cells = [f"{found.counts[outcome]:,}" for outcome in OUTCOMES]
        lines.append(f"| {titles[name]} | {found.tried:,} | " + " | ".join(cells) + " |")
    cells = [f"{total[outcome]:,}" for outcome in OUTCOMES]
    lines.append(f"| all | {sum(total.values()):,} | " + " | ".join(cells) + " |")
    return "\n".join(lines)
