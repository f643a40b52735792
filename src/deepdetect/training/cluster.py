"""Which of several training processes this one is, as `torchrun` tells in the environment."""

from __future__ import annotations

import datetime
import itertools
import os
from dataclasses import dataclass

from .._shared.errors import OptionError

BARRIER_TIMEOUT = datetime.timedelta(hours=24)
_meetings = itertools.count()  # each has its own name in the store


@dataclass(frozen=True)
class DistributedContext:
    """A process among those of a run.

    Attributes:
        rank: its number among all.
        processes: how many there are in all.
        local_rank: its number among those of this machine.
        local_processes: how many run on this machine, as many as on the others.
    """

    rank: int = 0
    processes: int = 1
    local_rank: int = 0
    local_processes: int = 1

    def __post_init__(self) -> None:
        if self.processes % self.local_processes:
            raise OptionError(
                "there must be as many processes on each machine: "
                "give torchrun the same --nproc-per-node everywhere"
            )

    @property
    def is_first(self) -> bool:
        """Whether it writes the files and shows the progress."""
        return self.rank == 0

    @property
    def machines(self) -> int:
        """How many machines there are, with as many processes each."""
        return self.processes // self.local_processes

    def local_slice(self, count: int) -> slice:
        """Return this process's part of a batch, all parts being of one size.

        Raises:
            OptionError: it cannot be shared evenly.

        Example:
            >>> DistributedContext(1, 2, 1, 2).local_slice(8)
            slice(4, 8, None)
        """
        if count % self.processes:
            raise OptionError(
                f"a batch of {count} cannot be shared evenly by {self.processes} processes: "
                "choose a multiple of their number with --stage"
            )
        part = count // self.processes
        return slice(self.rank * part, (self.rank + 1) * part)


def distributed_context() -> DistributedContext:
    """Read this process's place; without `torchrun` it is the only one.

    Raises:
        OptionError: the machines have different numbers of processes.

    Example:
        >>> distributed_context().processes >= 1
        True
    """
    if "TORCHELASTIC_RUN_ID" not in os.environ:
        return DistributedContext()
    names = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
    return DistributedContext(*(int(os.environ[name]) for name in names))


def wait_for_all(place: DistributedContext) -> None:
    """Wait until every process has come here, for hours if need be.

    Through torchrun's own store, so that the time limits of the training itself, within
    which a dead process is noticed, stay short.

    All processes must call it equally often.

    Args:
        place: this process.
    """
    if place.processes == 1:
        return
    from torch.distributed import PrefixStore, rendezvous

    store, _, _ = next(iter(rendezvous("env://", place.rank, place.processes)))
    restart = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")
    meeting = PrefixStore(f"deepdetect-{restart}-{next(_meetings)}", store)
    meeting.set(str(place.rank), "here")
    meeting.wait([str(rank) for rank in range(place.processes)], BARRIER_TIMEOUT)
