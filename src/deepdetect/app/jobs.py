"""Tasks of the page: each has a process and a folder, until the page stops asking for it."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import secrets
import shutil
import tempfile
import threading
import time
from dataclasses import dataclass, fields
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from .._shared.atomic import private_folder
from .._shared.errors import DeepDetectError, OptionError
from .._shared.machine import end_with_parent
from .._shared.options import check_ranges, suggest_keywords
from .._shared.signals import kill_group, signals_held
from ..io.image import one_range
from ..io.image_file import read_with, reading_options
from .tasks import TASKS, Order

FOLDER_PREFIX = "deepdetect-app-"
"""Prefix of the name of a server's folder, which is in the folder for temporary files."""

NO_RESULT = "the task ended without a result: there may be too little memory for it"


@suggest_keywords
@dataclass(frozen=True)
class AppOptions:
    """Limits of the local server that serves the app's page.

    Attributes:
        port: port of 127.0.0.1; 0 takes any free one.
        max_file_mb: largest size of an image file, in megabytes.
        max_task_mb: largest total size of the image files of one task, in megabytes.
        max_files: largest number of images of one task.
        max_megapixels: larger images are rejected before they are decoded.
        max_tasks: largest number of tasks that run at the same time.
        max_task_s: seconds after which a task is stopped.
        abandoned_s: seconds without a request from the page, after which a task and its result are
            discarded. A page in a background tab sends a request only once a minute.
        max_request_s: seconds within which all images of a task must arrive.

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


class Job:
    """A task and its process.

    Attributes:
        name: secret name of the task, which only the page knows.
        state: what is sent to the page: the progress, the result or an error.
        started, asked: `time.monotonic()` at the start, and at the page's last request for it.
    """

    def __init__(self, order: Order) -> None:
        self.name = secrets.token_urlsafe(24)
        self.folder = order.folder
        self.started = self.asked = time.monotonic()
        self.state: dict[str, Any] = {"state": "running", "stage": "starting"}
        self._reason = NO_RESULT
        context = multiprocessing.get_context("spawn")
        self._receiver, sender = context.Pipe(duplex=False)
        self.process = context.Process(target=run_task, args=(sender, order))
        with signals_held(), sender:  # Ctrl-C ends the server, which ends the tasks
            self.process.start()
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    def file(self, name: str) -> Path | None:
        """Return one of the result files of the task, or None for any other name."""
        files = [*self.state.get("files", ()), self.state.get("shown")]
        return self.folder / "results" / name if name in files else None

    def stop(self, reason: str) -> None:
        """End the process and all processes that it has started."""
        self._reason = reason
        if self.process.pid is not None:
            kill_group(self.process.pid)
        self.process.kill()  # Windows has no groups, and a new process has not made its own yet
        self._listener.join()

    def _listen(self) -> None:
        with contextlib.suppress(EOFError, OSError), self._receiver:  # the process was killed
            while True:
                self.state = self._receiver.recv()
        self.process.join()
        if self.state["state"] == "running":
            self.state = {"state": "failed", "error": self._reason}


class Jobs:
    """All tasks of a server. Only the server's own thread may start tasks."""

    def __init__(self, limits: AppOptions) -> None:
        self.limits = limits
        self._jobs: dict[str, Job] = {}
        self._folder = private_folder(FOLDER_PREFIX)

    def new_folder(self) -> Path:
        """Make a folder, which other users cannot read, for the images of a task."""
        return Path(tempfile.mkdtemp(dir=self._folder))

    def check_room(self) -> None:
        """Raise an OptionError if too many tasks are running."""
        if sum(job.process.is_alive() for job in self._jobs.values()) >= self.limits.max_tasks:
            raise OptionError(
                f"too many tasks ({self.limits.max_tasks}) are running: wait, or cancel one"
            )

    def start(self, order: Order) -> Job:
        """Start a task, or raise an OptionError if too many are running."""
        self.check_room()
        job = Job(order)
        self._jobs[job.name] = job
        return job

    def find(self, name: str) -> Job | None:
        """Return a task by its name, and note the time of this request."""
        if job := self._jobs.get(name):
            job.asked = time.monotonic()
        return job

    def remove(self, name: str) -> None:
        """End the task of this name, if it exists, and remove its files."""
        if job := self._jobs.pop(name, None):
            job.stop("the task was cancelled")
            shutil.rmtree(job.folder, ignore_errors=True)

    def end_overdue(self) -> None:
        """End tasks that take too long; remove tasks for which the page sends no more requests."""
        now = time.monotonic()
        for job in list(self._jobs.values()):
            if now - job.asked > self.limits.abandoned_s:
                self.remove(job.name)
            elif job.process.is_alive() and now - job.started > self.limits.max_task_s:
                minutes = self.limits.max_task_s / 60
                job.stop(f"the task took over {minutes:.3g} minutes: use fewer or smaller images")

    def close(self) -> None:
        """End all tasks, and remove all files."""
        for name in list(self._jobs):
            self.remove(name)
        shutil.rmtree(self._folder, ignore_errors=True)


def run_task(sender: Connection, order: Order) -> None:
    """Run a task in its own process: write files to the folder `results`, and send states."""
    if hasattr(os, "setsid"):
        os.setsid()  # makes a process group, so that child processes can be ended
    for stream in (1, 2):  # discard what libraries print
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    end_with_parent(kill_group)
    results = order.folder / "results"
    results.mkdir()

    def report(stage: str, done: int, total: int) -> None:
        sender.send({"state": "running", "stage": stage, "done": done, "total": total})

    try:
        limited = reading_options(max_megapixels=order.max_megapixels)
        with read_with(limited), one_range([image.path for image in order.images]):
            result = TASKS[order.kind].run(order.images, order.options, results, report)
        sender.send({"state": "done", **vars(result)})
        return
    except DeepDetectError as error:
        reason = _for_the_page(str(error), order)
    except MemoryError:
        reason = "there is not enough memory for this: use smaller images"
    except OSError as error:
        reason = f"the files cannot be written ({error.strerror or error}): free some space"
    sender.send({"state": "failed", "error": reason})


def _for_the_page(message: str, order: Order) -> str:
    """Replace paths in a message by the user's file names, and options by command-line flags."""
    for image in order.images:
        message = message.replace(str(image.path), image.name)
    for path in (order.folder / "results", order.folder):
        message = message.replace(f"{path}{os.sep}", "")
    message = message.replace(" (or set `force`)", "")  # the page has no such option
    return message.replace("`max_megapixels`", "--max-megapixels")
