"""What a target is, and how the outcome of a case is told."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from deepdetect import DeepDetectError

OUTCOMES = ("right", "refused", "traceback", "crash", "hang", "wrong")
DEFECTS = OUTCOMES[2:]


class Wrong(Exception):
    """The library took an input and returned something that it must not return."""


@dataclass(frozen=True)
class Target:
    """A part of the library that reads what may be wrong.

    Attributes:
        name: how it is chosen and listed.
        title: what it is, in the table.
        run: makes the input of a generator, gives it to the library, and raises `Wrong` where the
            result cannot be right; gets a folder of its own for files.
        count: inputs in a whole campaign.
        batch: inputs of one child process.
        limit_s: seconds of wall time after which an input hangs; the machine may be busy.
    """

    name: str
    title: str
    run: Callable[[np.random.Generator, Path], Any]
    count: int
    batch: int = 250
    limit_s: float = 60.0


Made = TypeVar("Made")


def prepared(make: Callable[[], Made]) -> Callable[[], Made]:
    """Make something once for all inputs; that it is refused is an error of the campaign's."""

    @functools.cache
    def once() -> Made:
        try:
            return make()
        except DeepDetectError as error:
            raise RuntimeError(f"{make.__name__} failed: {error}") from error

    return once


def expect(condition: object, what: str) -> None:
    """Raise `Wrong` unless a condition holds."""
    if not condition:
        raise Wrong(what)
