#!/usr/bin/env bash
# threadpoolctl 3.8 ignores, silently, limits of OpenBLAS from every thread but the first that holds one.
#
# Up to 3.7, `threadpool_limits(1, user_api="blas")` in any thread sets the number of threads of NumPy's OpenBLAS, which
# is one for the whole process. From 3.8 on, the first thread that sets a limit owns the library until its limit ends.
# Limits of other threads neither change anything nor warn. So a worker thread that asks for one thread while the main
# thread holds a limit of two computes with two; a limit that was set without `with`, to stay, keeps all others out; and
# a limit that another thread lifts stays. For calls that overlap in several threads this is what one wants: their order
# of ending no longer matters. Run by hand; exits with 1 where the behaviour is another.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for version in 3.7.0 3.8.0; do
    python3 -m venv --clear "$folder/venv"
    "$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check numpy==2.4.6 threadpoolctl==$version
    OPENBLAS_NUM_THREADS=2 "$folder/venv/bin/python" - <<'PYTHON'
import sys
import threading

import numpy  # loads OpenBLAS
import threadpoolctl
from threadpoolctl import threadpool_info, threadpool_limits


def threads():
    (blas,) = [each for each in threadpool_info() if each["user_api"] == "blas"]
    return blas["num_threads"]


def in_thread(function):
    outcome = []
    thread = threading.Thread(target=lambda: outcome.append(function()))
    thread.start()
    thread.join()
    return outcome[0]


def limited():
    with threadpool_limits(1, user_api="blas"):
        return threads()


def lift():
    held.restore_original_limits()
    return threads()


seen = {"a worker's own limit": in_thread(limited)}
with threadpool_limits(2, user_api="blas"):
    seen["a worker's limit while the main thread holds one"] = in_thread(limited)
held = threadpool_limits(1, user_api="blas")
seen["after a worker has lifted the main thread's limit"] = in_thread(lift)
for what, count in seen.items():
    print(f"numpy {numpy.__version__}, threadpoolctl {threadpoolctl.__version__}: {what}: {count} threads")
expected = {"3.7.0": [1, 1, 2], "3.8.0": [1, 2, 1]}[threadpoolctl.__version__]
sys.exit([*seen.values()] != expected)
PYTHON
done
