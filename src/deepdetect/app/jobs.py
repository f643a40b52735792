"""Tasks at work: a process and a folder each, forgotten when the page has no more use for them."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .._shared.atomic import private_folder
from .._shared.errors import DeepDetectError, OptionError
from .options import AppOptions

FOLDER_PREFIX = "deepdetect-app-"
"""Of the folder of a server, in the folder for temporary files."""

CHECK_EVERY_S = 1.0
"""How often it is looked for tasks that last too long or are forgotten."""


class Job:
    """A task, the process that does it, and the folder of its files.

    Args:
        folder: its own, with the photographs in it; removed by `remove`.
        kind: of the task.
        photographs: pairs of a file's name in the folder and the name that the user knows it by.
        options: of the task.
        limits: of the server.
    """

    def __init__(
        self,
        folder: Path,
        kind: str,
        photographs: Sequence[tuple[str, str]],
        options: Mapping[str, float],
        limits: AppOptions,
    ) -> None:
        self.name = secrets.token_urlsafe(24)
        self.folder = folder
        self.started = self.asked = time.monotonic()
        self._lock = threading.Lock()
        self._state: dict[str, Any] = {"state": "running", "stage": "starting"}
        task = {
            "kind": kind,
            "photographs": [{"file": file, "name": name} for file, name in photographs],
            "options": dict(options),
            "max_megapixels": limits.max_megapixels,
        }
        (folder / "task.json").write_text(json.dumps(task), encoding="utf-8")
        self._process = subprocess.Popen(
            # -P: no module is taken from the folder it is started in.
            [sys.executable, "-P", "-m", f"{__package__}.worker", str(folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd=folder,
            env=_environment(),
            start_new_session=True,  # so that all it starts can be ended
        )
        threading.Thread(target=self._listen, daemon=True).start()

    def state(self) -> dict[str, Any]:
        """Return what the page is told, and note that it has asked."""
        self.asked = time.monotonic()
        with self._lock:
            return dict(self._state)

    @property
    def running(self) -> bool:
        """Whether the process is at work."""
        return self._process.poll() is None

    def file(self, name: str) -> Path | None:
        """Return one of the files that the task has named; None for any other name."""
        with self._lock:
            files = [*self._state.get("files", ()), self._state.get("shown")]
        self.asked = time.monotonic()
        return self.folder / "results" / name if name in files else None

    def stop(self, reason: str) -> None:
        """End the process with all that it has started."""
        with self._lock:
            if self._state["state"] == "running":
                self._state = {"state": "failed", "error": reason}
        if self.running:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                if hasattr(os, "killpg"):
                    os.killpg(self._process.pid, signal.SIGKILL)
                else:
                    self._process.kill()
        self._end()

    def remove(self) -> None:
        """End the process, and remove all files."""
        self.stop("it was cancelled")
        shutil.rmtree(self.folder, ignore_errors=True)

    def _listen(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                with contextlib.suppress(ValueError):
                    self._note(json.loads(line))
        self._end()
        with self._lock:
            if self._state["state"] == "running":
                reason = "the task ended without a result: there may be too little memory for it"
                self._state = {"state": "failed", "error": reason}

    def _end(self) -> None:
        """Wait for the process, and close what it was held by."""
        self._process.wait()
        assert self._process.stdin is not None
        self._process.stdin.close()

    def _note(self, told: dict[str, Any]) -> None:
        with self._lock:
            if self._state["state"] != "running":
                return
            if "result" in told:
                self._state = {"state": "done", **told["result"]}
            elif "error" in told:
                self._state = {"state": "failed", "error": told["error"]}
            else:
                self._state = {"state": "running", **told}


def _environment() -> dict[str, str]:
    """Return this process's variables, so that the worker finds the package where this one is."""
    root = str(Path(__file__).parents[2])
    given = os.environ.get("PYTHONPATH")
    return {**os.environ, "PYTHONPATH": f"{root}{os.pathsep}{given}" if given else root}


class Jobs:
    """All tasks of a server.

    Args:
        limits: of the server.
    """

    def __init__(self, limits: AppOptions) -> None:
        self.limits = limits
        self._jobs: dict[str, Job] = {}
        self._lock = threading.Lock()
        self._folder = private_folder(FOLDER_PREFIX)
        self._closed = threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    @contextmanager
    def new_folder(self) -> Iterator[Path]:
        """Make a folder for the photographs of a task, which nobody else can read.

        It is removed where the task cannot be started.

        Raises:
            DeepDetectError: files cannot be written, or the process cannot be started.
        """
        folder = None
        try:
            folder = Path(tempfile.mkdtemp(dir=self._folder))
            yield folder
        except BaseException as error:
            if folder is not None:
                shutil.rmtree(folder, ignore_errors=True)
            if isinstance(error, DeepDetectError | ConnectionError | TimeoutError):
                raise  # the browser has ended the request, or is too slow
            if isinstance(error, OSError):
                raise DeepDetectError(
                    f"the task cannot be started ({error.strerror or error}): free some space and "
                    "memory, or start deepdetect app again"
                ) from error
            raise

    def check_room(self) -> None:
        """Raise an OptionError where too many tasks are at work."""
        with self._lock:
            self._check_room()

    def _check_room(self) -> None:
        at_work = sum(job.running for job in self._jobs.values())
        if at_work >= self.limits.max_tasks:
            raise OptionError(
                f"as many tasks as are allowed ({self.limits.max_tasks}) are at work: wait for one "
                "of them, or cancel it"
            )

    def start(
        self,
        folder: Path,
        kind: str,
        photographs: Sequence[tuple[str, str]],
        options: Mapping[str, float],
    ) -> Job:
        """Start a task with the photographs of a folder.

        Raises:
            DeepDetectError: the server ends, or too many tasks are at work.
        """
        with self._lock:  # two requests at once must not both take the last place
            self._check_room()
            job = Job(folder, kind, photographs, options, self.limits)
            self._jobs[job.name] = job
        if self._closed.is_set():
            self.close()
            raise DeepDetectError("deepdetect app is ending: start it again")
        return job

    def find(self, name: str) -> Job | None:
        """Return a task by its name."""
        with self._lock:
            return self._jobs.get(name)

    def remove(self, name: str) -> bool:
        """End a task, and remove its files; return whether there was one."""
        with self._lock:
            job = self._jobs.pop(name, None)
        if job is not None:
            job.remove()
        return job is not None

    def close(self) -> None:
        """End all tasks, and remove all files."""
        self._closed.set()
        with self._lock:
            names = list(self._jobs)
        for name in names:
            self.remove(name)
        shutil.rmtree(self._folder, ignore_errors=True)

    def _watch(self) -> None:
        while not self._closed.wait(min(CHECK_EVERY_S, self.limits.abandoned_s / 4)):
            now = time.monotonic()
            with self._lock:
                jobs = list(self._jobs.values())
            for job in jobs:
                if now - job.asked > self.limits.abandoned_s:
                    self.remove(job.name)
                elif job.running and now - job.started > self.limits.max_task_s:
                    minutes = self.limits.max_task_s / 60
                    job.stop(
                        f"it took over {minutes:.3g} minutes: use fewer or smaller photographs"
                    )
