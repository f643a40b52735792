"""What a check of `deepdetect doctor` finds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

from .._shared.errors import DeepDetectError

Status = Literal["ok", "missing", "warning", "problem"]


@dataclass(frozen=True)
class Finding:
    """What a check found.

    Attributes:
        name: what was looked at, as "OpenCV".
        status: "ok"; "missing" where something optional is not installed; "warning" where
            something works, but slower or not as usual; "problem" where something does not work.
        value: what is there, for people.
        remedy: what to do in a sentence; empty where nothing is to be done.
        details: the same in plain values, for programs.
    """

    name: str
    status: Status
    value: str
    remedy: str = ""
    details: dict[str, Any] = field(default_factory=dict)


def findings_of(check: Callable[[], Iterator[Finding]]) -> list[Finding]:
    """Run a check; what it raises becomes a finding, so that the others are made."""
    found: list[Finding] = []
    try:
        found.extend(check())
    except Exception as error:
        name = check.__name__.removeprefix("check_").replace("_", " ")
        found.append(Finding(name, "problem", "the check itself failed", as_sentence(error)))
    return found


def as_sentence(error: BaseException) -> str:
    """Return an error in one line; its kind, where it is none of ours."""
    line = (str(error).splitlines() or [""])[0]
    text = line if isinstance(error, DeepDetectError) else f"{type(error).__name__}: {line}"
    return text[:1].upper() + text[1:] + "."
