from __future__ import annotations

import os
import subprocess
import sys

import pytest

ALLOWED = """
import os
if {bind}: os.sched_setaffinity(0, [max(os.sched_getaffinity(0))])
from deepdetect import DeepDetect
import numpy as np
before = len(os.listdir("/proc/self/task"))
DeepDetect().detect(np.zeros((64, 64), np.uint8))
print(len(os.listdir("/proc/self/task")) - before)
print(*{{len(os.sched_getaffinity(int(task))) for task in os.listdir("/proc/self/task")}})
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs a list of threads")
@pytest.mark.parametrize("limit", ["processors", "OMP_NUM_THREADS"])
def test_no_more_threads_than_allowed(limit: str) -> None:
    environment = {name: value for name, value in os.environ.items() if "NUM_THREADS" not in name}
    environment |= {"OMP_NUM_THREADS": "1"} if limit == "OMP_NUM_THREADS" else {}
    script = ALLOWED.format(bind=limit == "processors")
    run = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    threads, processors = run.stdout.splitlines()
    assert int(threads) == 0
    if limit == "processors":
        assert processors == "1"
