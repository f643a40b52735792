"""Try wrong input and kills, and print the table of `docs/limits.md`.

    python -m fuzz                       # everything: about a quarter of an hour on two cores
    python -m fuzz --seconds 600         # what can be done in ten minutes, of all targets
    python -m fuzz --only png --show 3   # one target; print the first defects
    python -m fuzz --only png --input 71 # one input once more, with its traceback

Exit code 1 where anything but "right" and "refused" came of an input.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from .campaign import as_table, run_campaign
from .kills import COMMANDS, KILL_COLUMNS, run_kills
from .targets import TARGETS


def main() -> None:
    """Run the campaign."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--only", nargs="*", choices=[*TARGETS, "kills"], help="targets")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--share", type=float, default=1.0, help="of the inputs of each target")
    parser.add_argument("--seconds", type=float, help="no further inputs after them")
    parser.add_argument("--kills", type=int, default=90, help="number of killed commands")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--show", type=int, default=5, help="defects to print of each target")
    parser.add_argument("--input", type=int, help="number of one input to repeat here")
    arguments = parser.parse_args()
    names = arguments.only or [*TARGETS, "kills"]
    if arguments.input is not None:
        with tempfile.TemporaryDirectory() as folder:
            generator = np.random.default_rng([arguments.seed, arguments.input])
            print(TARGETS[names[0]].run(generator, Path(folder)))
        return
    findings = run_campaign(
        [TARGETS[name] for name in names if name != "kills"],
        seed=arguments.seed,
        share=arguments.share,
        seconds=arguments.seconds,
        processes=arguments.processes,
    )
    bad = 0
    for name, found in findings.items():
        bad += len(found.defects)
        for number, outcome, reason in sorted(found.defects)[: arguments.show]:
            print(f"--- {name} {number}: {outcome}\n{reason}\n")
    print(as_table(findings, {name: target.title for name, target in TARGETS.items()}))
    if "kills" in names and arguments.kills:
        rows = run_kills(arguments.kills, seed=arguments.seed)
        print("\n| command | " + " | ".join(KILL_COLUMNS) + " |")
        print("|---|" + "--:|" * len(KILL_COLUMNS))
        for name in COMMANDS:
            row = rows[name]
            print(f"| {name} | " + " | ".join(str(row[column]) for column in KILL_COLUMNS) + " |")
            bad += row["unreadable"] + row["rerun differs"]
    raise SystemExit(bool(bad))


if __name__ == "__main__":
    main()
