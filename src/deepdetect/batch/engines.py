"""Engines that run the tasks of a collection: processes of this machine, or a Ray cluster.

To add an engine, write a function with the signature of `map_in_processes` and add it to `ENGINES`.
Ray repeats the tasks of a worker that dies, so a task may run twice. Each task must therefore write
its files under temporary names, and rename a file when it is complete.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from .._shared.errors import DeepDetectError, OptionError, first_line, require_packages
from .._shared.machine import (
    Outcome,
    Task,
    TaskMap,
    disable_malloc_trim,
    map_in_processes,
    processor_count,
    recorded,
    temporarily,
    told,
    use_one_thread,
)

MAX_BLOCKS = 4096
"""Tasks make at most this many Ray blocks, each of which costs milliseconds. Chosen by hand."""

PROCESSORS_PER_WORKER = 0.5
"""Each worker reserves only this fraction of a processor in Ray. If up to half of the machines are
lost, the others can then take over their workers, and no task waits forever for a processor."""

OBJECT_STORE_BYTES = 200_000_000
"""Shared memory of a cluster that this module starts. Little suffices: results go to files."""

SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_BACKEND_LOG_LEVEL": "fatal",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # avoids a warning by Ray
}

DATA_SETTINGS = {"enable_progress_bars": False, "print_on_execution_start": False}


def map_on_ray(
    function: Callable[[Task], Outcome], tasks: Sequence[Task], workers: int | None = None
) -> Iterator[Outcome]:
    """Apply a function to every task on a Ray cluster, in workers of one processor each.

    The cluster is the one to which this process is connected, or else the one that RAY_ADDRESS
    names, or else one that runs on this machine (`ray start`). If there is none, or
    with RAY_ADDRESS=local, a cluster is started for the duration of the work. All machines of the
    cluster need this package, and the files under the same paths. Raises a DeepDetectError if the
    cluster fails, or if the function raises one.
    """
    if workers is not None and workers < 1:
        raise OptionError(f"`workers` must be at least 1, not {workers}")
    for name, value in SETTINGS.items():
        os.environ.setdefault(name, value)
    require_packages("the engine ray", "ray")
    import ray
    import ray.data
    import ray.exceptions

    if not len(tasks):
        return
    # Ray prints messages about its workers to standard output, which is for results.
    with contextlib.redirect_stdout(sys.stderr), _connected(ray, workers):
        count = min(workers or int(ray.cluster_resources().get("CPU", 1)), len(tasks))
        rows = ray.data.from_items(
            [{"task": pickle.dumps(task)} for task in tasks],
            override_num_blocks=min(len(tasks), MAX_BLOCKS),
        )
        outcomes = rows.map(
            _Worker,
            fn_constructor_args=(function, os.getcwd()),
            compute=ray.data.ActorPoolStrategy(size=count),
            num_cpus=PROCESSORS_PER_WORKER,
        )
        try:
            for row in outcomes.iter_rows():
                outcome = pickle.loads(row["outcome"])
                if isinstance(outcome, DeepDetectError):
                    raise outcome
                yield told(outcome)
        except (ray.exceptions.RayActorError, ray.exceptions.RaySystemError) as error:
            raise DeepDetectError(
                f"the Ray cluster failed ({first_line(error)}): check it, then run this again"
            ) from error


class _Worker:
    def __init__(self, function: Callable[[Any], Any], folder: str) -> None:
        self.function = function
        with contextlib.suppress(OSError):  # relative paths start at the caller's folder
            os.chdir(folder)
        use_one_thread()
        disable_malloc_trim()

    def __call__(self, row: dict[str, Any]) -> dict[str, Any]:
        try:
            outcome: Any = recorded(self.function, pickle.loads(row["task"]))
        except DeepDetectError as error:  # if raised, Ray would add a traceback
            outcome = error
        return {"outcome": pickle.dumps(outcome)}


def _start_cluster(ray: Any, processors: int, quiet: dict[str, Any]) -> None:
    options = {"include_dashboard": False, "object_store_memory": OBJECT_STORE_BYTES, **quiet}
    try:
        ray.init(address="local", num_cpus=processors, **options)
    except Exception as error:  # Ray raises errors of many types, after half a minute
        ray.shutdown()
        raise DeepDetectError(
            f"Ray cannot start ({first_line(error)}): try later, or use the engine 'processes'"
        ) from error


@contextmanager
def _connected(ray: Any, workers: int | None) -> Iterator[None]:
    """Connect to a Ray cluster or start one, unless already connected; silence Ray Data."""
    before = ray.is_initialized()
    quiet = {"log_to_driver": False, "logging_level": logging.ERROR}
    if not before:
        address = os.environ.get("RAY_ADDRESS")
        try:
            if address == "local":
                raise ConnectionError
            ray.init(address="auto", **quiet)
        except ConnectionError as error:
            if address not in (None, "local"):
                raise DeepDetectError(
                    f"there is no Ray cluster at {address}: start it, or unset RAY_ADDRESS"
                ) from error
            _start_cluster(ray, workers or processor_count(), quiet)
    context = ray.data.DataContext.get_current()
    logger = logging.getLogger("ray.data")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        with temporarily(context, **DATA_SETTINGS):
            yield
    finally:
        logger.setLevel(level)
        if not before:
            ray.shutdown()


ENGINES: dict[str, TaskMap] = {"processes": map_in_processes, "ray": map_on_ray}
