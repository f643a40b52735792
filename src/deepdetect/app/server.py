"""The server of the page: what it is asked for and answers, for one user, keeping nothing."""

from __future__ import annotations

import json
import threading
from functools import cached_property
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

from .. import __version__
from .._shared.errors import DeepDetectError, OptionError, unknown_name
from ..detector.pretrained import RANKER
from .guarded_http import (
    HOST,
    PAGE_POLICY,
    VIEWER_POLICY,
    GuardedHandler,
    GuardedServer,
    Refused,
)
from .jobs import Jobs
from .options import AppOptions
from .tasks import TASKS

STATIC = Path(__file__).parent / "static"

MAX_HEATMAP_PIXELS = 2_100_000
"""The page reduces photographs to two megapixels, with sides that are multiples of 8."""

MIN_SIDE = 16
MAX_DESCRIPTION_BYTES = 1 << 18
"""Of the names and sizes of photographs, and of the options of a task."""

MAX_NAME_LENGTH = 200


class AppServer(GuardedServer):
    """Serves the page until it is closed.

    Args:
        options: its port and its limits.

    Attributes:
        key: the secret of this start, which every request but those for the page must have.
        address: of the page, with the key.

    Raises:
        OptionError: the port is taken.
        DeepDetectError: there is no folder for temporary files.

    Example:
        >>> with AppServer(AppOptions(port=0)) as server:
        ...     server.address.startswith("http://127.0.0.1:")
        True
    """

    def __init__(self, options: AppOptions = AppOptions()) -> None:
        self.options = options
        self.network = threading.Lock()  # one photograph at a time: it takes all processors
        super().__init__(options.port, Handler, options.max_request_s)
        try:
            self.jobs = Jobs(options)
        except DeepDetectError:
            self.server_close()
            raise
        self.pages = {
            f"/{path.relative_to(STATIC).as_posix()}": path
            for path in STATIC.rglob("*")
            if path.is_file()
        }
        self.pages["/model/ranker.npz"] = RANKER  # where a build for other servers has it, too

    @property
    def address(self) -> str:
        """The address of the page."""
        return f"http://{HOST}:{self.server_port}/#key={self.key}"

    @cached_property
    def detector(self) -> Any:
        """The network, opened when it is first needed."""
        from ..detector.detector import DeepDetect

        return DeepDetect(resolution="native")

    def server_close(self) -> None:
        """End all tasks, and remove their files."""
        super().server_close()
        if hasattr(self, "jobs"):
            self.jobs.close()

    def description(self) -> dict[str, Any]:
        """Return what the page is told of this server."""
        options = self.options
        tasks = [
            {
                "kind": kind,
                "title": task.title,
                "note": task.note,
                "files": [task.files[0], task.files[1] or options.max_files],
                "options": dict(task.options),
                "folder": task.folder,
                "missing": task.missing,
            }
            for kind, task in TASKS.items()
        ]
        limits = {
            "file_mb": options.max_file_mb,
            "task_mb": options.max_task_mb,
            "files": options.max_files,
        }
        return {"engine": "python", "version": __version__, "tasks": tasks, "limits": limits}


class Handler(GuardedHandler):
    """Answers one connection."""

    server: AppServer

    def do_GET(self) -> None:
        self.answer(self._get)

    def do_POST(self) -> None:
        self.answer(self._post)

    def do_DELETE(self) -> None:
        self.answer(self._delete)

    def _get(self, url: Any) -> None:
        if url.path == "/config.json":
            self.send_json(self.server.description())
            return
        page = self.server.pages.get("/index.html" if url.path == "/" else url.path)
        if page is not None:
            self.send_file(page, PAGE_POLICY)
            return
        job, rest = self._job(url.path)
        name = rest.removeprefix("files/")
        if not rest:
            self.check_key()
            self.send_json(job.state())
            return
        path = job.file(name) if rest.startswith("files/") else None
        if path is None:
            raise Refused(HTTPStatus.NOT_FOUND, "there is no such file")
        if path.suffix == ".html":  # a frame cannot send the key: the task's name is one, too
            self.send_file(path, VIEWER_POLICY)
            return
        self.check_key()
        self.send_file(path, PAGE_POLICY)

    def _post(self, url: Any) -> None:
        self.check_key()
        query = {name: values[-1] for name, values in parse_qs(url.query).items()}
        if url.path == "/api/heatmap":
            self._heatmap(query)
        elif url.path == "/api/jobs":
            self._new_job(query.get("kind", ""))
        else:
            raise Refused(HTTPStatus.NOT_FOUND, "there is nothing at this address")

    def _delete(self, url: Any) -> None:
        self.check_key()
        job, _ = self._job(url.path)
        self.server.jobs.remove(job.name)
        self.send_json({})

    def _job(self, path: str) -> Any:
        """Return the task that a path names, and the rest of the path."""
        name, _, rest = path.removeprefix("/api/jobs/").partition("/")
        job = self.server.jobs.find(name) if path.startswith("/api/jobs/") else None
        if job is None:
            raise Refused(HTTPStatus.NOT_FOUND, "there is no such task: it may have been forgotten")
        return job, rest

    def _heatmap(self, query: dict[str, str]) -> None:
        """Answer the pixels of a photograph, (H, W, 3) uint8, with its logits, (H, W) float32."""
        import numpy as np

        try:
            width, height = int(query["width"]), int(query["height"])
        except (KeyError, ValueError):
            raise Refused(HTTPStatus.BAD_REQUEST, "the size of the picture is missing") from None
        if min(width, height) < MIN_SIDE or width * height > MAX_HEATMAP_PIXELS:
            raise Refused(HTTPStatus.BAD_REQUEST, f"a picture cannot be {width}x{height} here")
        length = self.body_length(3 * width * height)
        if length != 3 * width * height:
            raise Refused(HTTPStatus.BAD_REQUEST, "these are not the pixels of such a picture")
        pixels = b"".join(self.pieces(length))
        rgb = np.frombuffer(pixels, np.uint8).reshape(height, width, 3)
        with self.server.network:
            logits = self.server.detector.heatmap_and_logits(rgb)[1]
        self.send(np.ascontiguousarray(logits, "<f4").tobytes(), "application/octet-stream")

    def _new_job(self, kind: str) -> None:
        """Start a task: a length, a description in JSON of that length, and the photographs."""
        options, jobs = self.server.options, self.server.jobs
        if kind not in TASKS:
            raise unknown_name("task", kind[:MAX_NAME_LENGTH], TASKS)
        left = self.body_length(int(options.max_task_mb * 1e6) + MAX_DESCRIPTION_BYTES)
        jobs.check_room()
        size = int.from_bytes(b"".join(self.pieces(min(4, left))))
        if not 0 < size <= min(MAX_DESCRIPTION_BYTES, left - 4):
            raise Refused(HTTPStatus.BAD_REQUEST, "the description of the task is missing")
        names, sizes, given = _described(b"".join(self.pieces(size)))
        if len(names) > options.max_files:
            raise OptionError(
                f"there are {len(names)} photographs, over {options.max_files}: give fewer, or "
                "allow more by --max-files"
            )
        for name, bytes_ in zip(names, sizes, strict=True):
            if bytes_ > options.max_file_mb * 1e6:
                raise OptionError(f"{name} is over {options.max_file_mb:g} MB: make it smaller")
        if sum(sizes) != left - 4 - size:
            raise Refused(HTTPStatus.BAD_REQUEST, "the photographs are not as long as is said")
        numbers = TASKS[kind].check(len(names), given)
        with jobs.new_folder() as folder:
            files = []
            for number, bytes_ in enumerate(sizes):
                files.append(f"{number:04d}{_suffix(names[number])}")
                with (folder / files[-1]).open("xb") as file:
                    for piece in self.pieces(bytes_):
                        file.write(piece)
            job = jobs.start(folder, kind, list(zip(files, names, strict=True)), numbers)
        self.send_json({"job": job.name})


def _described(text: bytes) -> tuple[list[str], list[int], dict[str, object]]:
    """Return the names and sizes of photographs, and the options, of a description in JSON."""
    try:
        values = json.loads(text)
        names = [_clean(str(one["name"])) for one in values["files"]]
        sizes = [one["size"] for one in values["files"]]
        options = dict(values["options"])
        whole = all(type(size) is int and size >= 0 for size in sizes)
    except (ValueError, TypeError, KeyError, RecursionError):
        whole = False
    if not whole:
        raise Refused(HTTPStatus.BAD_REQUEST, "the description of the task is damaged")
    return names, sizes, options


def _clean(name: str) -> str:
    """Return a name that can be shown: not too long, and of one line."""
    return "".join(c if c.isprintable() else "_" for c in name[-MAX_NAME_LENGTH:]) or "photograph"


def _suffix(name: str) -> str:
    """Return the ending of an image's file, empty where it is another."""
    from ..io.image import IMAGE_SUFFIXES

    suffix = Path(name).suffix.lower()
    return suffix if suffix in IMAGE_SUFFIXES else ""
