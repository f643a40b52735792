"""What runs the tasks of a collection: the processes of this machine, or a cluster.

To add an engine, write a function of the signature of `TaskMap` and add it to `ENGINES`.
"""

from __future__ import annotations

from .._shared.parallel import TaskMap, map_in_processes
from .._shared.registry import look_up
from .ray_engine import map_on_ray

ENGINES: dict[str, TaskMap] = {"processes": map_in_processes, "ray": map_on_ray}


def get_engine(name: str) -> TaskMap:
    """Return the engine of this name.

    Raises:
        OptionError: the name is unknown.

    Example:
        >>> list(get_engine("processes")(abs, [-1], workers=1))
        [1]
    """
    return look_up("engine", name, ENGINES)
