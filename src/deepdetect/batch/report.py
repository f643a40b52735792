"""What was done with the images of a collection."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .._shared.errors import BatchError


@dataclass(frozen=True)
class BatchReport:
    """What was extracted or matched.

    Attributes:
        path: the file.
        counts: keypoints of each image, or matches of each pair, that was done now.
        skipped: number of images or pairs that had been done before.
        failures: a sentence on each that could not be worked on.
        of: "images" or "pairs".
    """

    path: Path
    counts: dict[Any, int] = field(repr=False)
    skipped: int
    failures: tuple[str, ...]
    of: str

    def check(self) -> None:
        """Raise a BatchError where something failed."""
        if self.failures:
            total = len(self.counts) + self.skipped + len(self.failures)
            raise BatchError(
                f"{len(self.failures)} of {total} {self.of} failed, the others are done",
                self.failures,
            )
