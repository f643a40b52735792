"""What `deepdetect app` accepts, and for how long."""

from __future__ import annotations

from dataclasses import dataclass, fields

from .._shared.options import check_ranges, suggest_keywords


@suggest_keywords
@dataclass(frozen=True)
class AppOptions:
    """Limits of the server of the page.

    Attributes:
        port: of 127.0.0.1; 0 for any that is free.
        max_file_mb: size of the largest photograph, in megabytes.
        max_task_mb: size of all photographs of one task, in megabytes.
        max_files: number of photographs of one task.
        max_megapixels: larger photographs are refused before they are decoded.
        max_tasks: tasks that are at work at the same time.
        max_task_s: seconds after which a task is ended.
        abandoned_s: seconds without a question from the page after which a task, or its result,
            is forgotten. Pages in the background ask once a minute.
        max_request_s: seconds that the images of a task may take to arrive.

    Raises:
        OptionError: a value is out of its range.
    """

    port: int = 8642
    max_file_mb: float = 100.0
    max_task_mb: float = 1000.0
    max_files: int = 200
    max_megapixels: float = 100.0
    max_tasks: int = 2
    max_task_s: float = 3600.0
    abandoned_s: float = 300.0
    max_request_s: float = 300.0

    def __post_init__(self) -> None:
        limits = [field.name for field in fields(self) if field.name != "port"]
        check_ranges(self, between={"port": (0, 65535)}, positive=limits)
