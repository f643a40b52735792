"""A benchmark as a list of tasks, and what tables and figures are made from their results."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, TypeVar

from .baselines.method import LocalFeature
from .context import BenchmarkContext
from .report import Figure, Section, Table

Item = TypeVar("Item")
Shown = Sequence[Table | Figure]


class ProgressBar(Protocol):
    """What the tasks ask of a progress bar; tqdm has it."""

    def update(self, n: int) -> object: ...

    def set_postfix_str(self, s: str, refresh: bool) -> object: ...


@dataclass(frozen=True)
class Task:
    """A piece of work; the progress bar and the list of what was skipped give its name."""

    name: str
    run: Callable[[], Any]


@dataclass(frozen=True)
class Part:
    """Tables and figures with the tasks that they need.

    Attributes:
        tasks: by key.
        summarize: makes the tables and figures from the results by key; those of tasks that were
            skipped are missing.
    """

    tasks: Mapping[Any, Task]
    summarize: Callable[[Mapping[Any, Any]], Shown]


@dataclass(frozen=True)
class SectionPlan:
    """A section of a report that is still to be measured; its length is the number of tasks."""

    title: str
    text: tuple[str, ...]
    parts: Sequence[Part]

    def __len__(self) -> int:
        return sum(len(part.tasks) for part in self.parts)

    def run(self, context: BenchmarkContext, bar: ProgressBar) -> Section:
        """Run the tasks, and make the section; the bar moves by 1 with each task."""
        items: list[Table | Figure] = []
        for part in self.parts:
            results: dict[Hashable, Any] = {}
            for key, task in part.tasks.items():
                bar.set_postfix_str(task.name, refresh=False)
                found = context.try_run(task.name, task.run)
                if found is not None:
                    results[key] = found
                bar.update(1)
            items += part.summarize(results)
        return Section(
            self.title,
            self.text,
            tuple(item for item in items if isinstance(item, Table)),
            tuple(item for item in items if isinstance(item, Figure)),
        )


def feature_part(
    features: Sequence[LocalFeature],
    items: Mapping[str, Item],
    what: str,
    measure: Callable[[LocalFeature, Item], Any],
    summarize: Callable[[Mapping[tuple[str, str], Any]], Shown],
) -> Part:
    """Make the part that measures each feature on each item, by the names of both."""
    tasks = {
        (feature.name, name): Task(
            f"{what}{feature.title} on {name}", partial(measure, feature, item)
        )
        for feature in features
        for name, item in items.items()
    }
    return Part(tasks, summarize)


def figure_part(name: str, draw: Callable[[], Figure]) -> Part:
    """Make the part of a single figure."""
    return Part({0: Task(name, draw)}, lambda found: list(found.values()))
