"""Which of several training processes this one is, as `torchrun` tells in the environment."""

from __future__ import annotations

import os
from dataclasses import dataclass

from ..errors import OptionError


@dataclass(frozen=True)
class Place:
    """A process among those of a run.

    Attributes:
        rank: its number among all.
        processes: how many there are in all.
        local_rank: its number among those of this machine.
        local_processes: how many run on this machine.
    """

    rank: int = 0
    processes: int = 1
    local_rank: int = 0
    local_processes: int = 1

    @property
    def is_first(self) -> bool:
        """Whether it writes the files and shows the progress."""
        return self.rank == 0

    @property
    def machines(self) -> int:
        """How many machines there are, with as many processes each."""
        return self.processes // self.local_processes

    def share(self, count: int) -> slice:
        """Return this process's part of `count` things, all parts being of one size.

        Raises:
            OptionError: they cannot be shared evenly.

        Example:
            >>> Place(rank=1, processes=2, local_rank=1, local_processes=2).share(8)
            slice(4, 8, None)
        """
        if count % self.processes:
            raise OptionError(
                f"a batch of {count} cannot be shared evenly by {self.processes} processes: "
                "choose a multiple of their number with --stage"
            )
        part = count // self.processes
        return slice(self.rank * part, (self.rank + 1) * part)


def place_in_cluster() -> Place:
    """Read this process's place; without `torchrun` it is the only one.

    Example:
        >>> place_in_cluster().processes >= 1
        True
    """
    if "TORCHELASTIC_RUN_ID" not in os.environ:
        return Place()
    names = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
    return Place(*(int(os.environ[name]) for name in names))
