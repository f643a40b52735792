"""One batch of inputs, in a process of its own: `python -m fuzz.child TARGET SEED FROM TO`.

Before each input its number is written, after it the outcome, each as one line of JSON: whoever
reads them knows which input the process died of.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import sys
import tempfile
import traceback
import warnings
from pathlib import Path
from typing import TextIO

import numpy as np

from deepdetect import DeepDetectError

from .case import Target, Wrong
from .targets import TARGETS

MEMORY_BYTES = 8 << 30
"""Address space: well above what the libraries reserve, well below what a bomb takes."""


def main() -> None:
    """Run the batch."""
    name, seed, first, last = sys.argv[1], *map(int, sys.argv[2:5])
    # What libraries print must not get between the lines.
    report = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    warnings.simplefilter("ignore")
    target = TARGETS[name]
    for number in range(first, last):
        run(target, seed, number, report)


def run(target: Target, seed: int, number: int, report: TextIO) -> None:
    """Run one input and report its outcome."""
    report.write(json.dumps({"begins": number}) + "\n")
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    outcome, reason = "right", ""
    try:
        target.run(np.random.default_rng([seed, number]), folder)
    except DeepDetectError as error:
        outcome, reason = "refused", str(error)
        if not reason.strip() or "\n" in reason.strip():
            outcome, reason = "traceback", f"the message is no sentence: {reason!r}"
    except Wrong as error:
        outcome, reason = "wrong", str(error)
    except BaseException:
        outcome, reason = "traceback", traceback.format_exc()[-2000:]
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    report.write(json.dumps({"ends": number, "outcome": outcome, "reason": reason}) + "\n")


if __name__ == "__main__":
    main()
