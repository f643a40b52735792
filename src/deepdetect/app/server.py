"""The server of the page: on the loopback address only, for one user, keeping nothing.

The standard library's server is enough: one user, few requests, long work in processes of its own.
What it does not do is done here: it answers only requests that name this computer and come from its
own page with the key of this start, and that are neither too large nor too slow.
"""

from __future__ import annotations

import contextlib
import hmac
import json
import secrets
import shutil
import socket
import sys
import threading
import time
from functools import cached_property
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import SplitResult, parse_qs, urlsplit

from .. import __version__
from .._shared.errors import DeepDetectError, OptionError, unknown_name
from ..detector.pretrained import RANKER
from .jobs import Jobs
from .options import AppOptions
from .tasks import TASKS

STATIC = Path(__file__).parent / "static"

HOST = "127.0.0.1"
NAMES = (HOST, "localhost")
HTTP_PORT = 80

MAX_HEATMAP_PIXELS = 2_100_000
"""The page reduces photographs to two megapixels, with sides that are multiples of 8."""

MIN_SIDE = 16
MAX_DESCRIPTION_BYTES = 1 << 18
"""Of the names and sizes of photographs, and of the options of a task."""

MAX_NAME_LENGTH = 200
PIECE_BYTES = 1 << 20
DRAINED_BYTES = 16 << 20
"""Of a refused request that are read before it is answered: browsers look for the answer only when
they have sent everything. What was refused for its other contents is read whole."""

SLOWEST = 10
"""A request may last so many times as long in all as it may stand still."""

TYPES = {
    ".css": "text/css",
    ".csv": "text/csv",
    ".glb": "model/gltf-binary",
    ".html": "text/html",
    ".jpg": "image/jpeg",
    ".js": "text/javascript",
    ".json": "application/json",
    ".png": "image/png",
    ".svg": "image/svg+xml",
    ".txt": "text/plain",
    ".zip": "application/zip",
}

PAGE_POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; worker-src 'self'; "
    "style-src 'self'; img-src 'self' blob:; connect-src 'self'; frame-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
VIEWER_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "frame-ancestors 'self'; sandbox allow-scripts"
)
"""The viewer of a model is one file with its script in it, and cannot reach the page around it."""


class Refused(Exception):
    """A request that is not answered, with the status and the sentence that say why."""

    def __init__(self, status: HTTPStatus, sentence: str) -> None:
        self.status = status
        super().__init__(sentence)


class AppServer(ThreadingHTTPServer):
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

    daemon_threads = True

    def __init__(self, options: AppOptions = AppOptions()) -> None:
        self.options = options
        self.key = secrets.token_urlsafe(24)
        self.network = threading.Lock()  # one photograph at a time: it takes all processors
        try:
            super().__init__((HOST, options.port), Handler)
        except OSError as error:
            raise OptionError(
                f"port {options.port} cannot be used ({error.strerror}): give another `port`, or 0 "
                "for any that is free"
            ) from None
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

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of connections that the browser has ended."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)

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


class Handler(BaseHTTPRequestHandler):
    """Answers one connection."""

    server: AppServer
    protocol_version = "HTTP/1.1"

    def setup(self) -> None:
        super().setup()
        self.connection.settimeout(self.server.options.max_request_s)
        # What is answered is short, and waited for.
        self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, True)

    def version_string(self) -> str:
        return "deepdetect"

    def log_message(self, format: str, *args: Any) -> None:
        """Keep no log."""

    def do_GET(self) -> None:
        self._answer(self._get)

    def do_POST(self) -> None:
        self._answer(self._post)

    def do_DELETE(self) -> None:
        self._answer(self._delete)

    def _answer(self, method: Any) -> None:
        """Answer, or say in one sentence why not."""
        self.received, self.accepted_length = 0, 0
        self.deadline = time.monotonic() + SLOWEST * self.server.options.max_request_s
        try:
            try:
                self._check_source()
                method(self._url())
            except Refused as refusal:
                self._refuse(refusal.status, str(refusal))
            except DeepDetectError as error:
                self._refuse(HTTPStatus.BAD_REQUEST, str(error))
            if self._body_is_left():  # it would be taken for the next request
                self.close_connection = True
        except (ConnectionError, TimeoutError):
            self.close_connection = True

    def _url(self) -> SplitResult:
        try:
            return urlsplit(self.path)
        except ValueError:
            raise Refused(HTTPStatus.BAD_REQUEST, "this is not an address") from None

    def _body_is_left(self) -> bool:
        length = self.headers.get("Content-Length", "0")
        return "Transfer-Encoding" in self.headers or length != str(self.received)

    def _check_source(self) -> None:
        """Refuse requests for other computers (DNS rebinding), and of other pages."""
        hosts = self.headers.get_all("Host", [])
        port = self.server.server_port
        allowed = [f"{name}:{port}" for name in NAMES]
        if port == HTTP_PORT:  # browsers leave it out
            allowed += NAMES
        if len(hosts) != 1 or hosts[0] not in allowed:
            raise Refused(HTTPStatus.MISDIRECTED_REQUEST, "this address is not served here")
        origin = self.headers.get("Origin")
        if origin is not None and origin != f"http://{hosts[0]}":
            raise Refused(HTTPStatus.FORBIDDEN, "only the page of deepdetect app may ask this")

    def _check_key(self) -> None:
        given = self.headers.get("Authorization", "").removeprefix("Bearer ")
        if not hmac.compare_digest(given.encode(), self.server.key.encode()):
            raise Refused(
                HTTPStatus.UNAUTHORIZED,
                "the key of this page is not that of deepdetect app: open the address that it has "
                "printed",
            )
        if self.headers.get("Sec-Fetch-Site", "same-origin") != "same-origin":
            raise Refused(HTTPStatus.FORBIDDEN, "only the page of deepdetect app may ask this")

    def _get(self, url: Any) -> None:
        if url.path == "/config.json":
            self._send_json(self.server.description())
            return
        page = self.server.pages.get("/index.html" if url.path == "/" else url.path)
        if page is not None:
            self._send_file(page, PAGE_POLICY)
            return
        job, rest = self._job(url.path)
        name = rest.removeprefix("files/")
        if not rest:
            self._check_key()
            self._send_json(job.state())
            return
        path = job.file(name) if rest.startswith("files/") else None
        if path is None:
            raise Refused(HTTPStatus.NOT_FOUND, "there is no such file")
        if path.suffix == ".html":  # a frame cannot send the key: the task's name is one, too
            self._send_file(path, VIEWER_POLICY)
            return
        self._check_key()
        self._send_file(path, PAGE_POLICY)

    def _post(self, url: Any) -> None:
        self._check_key()
        query = {name: values[-1] for name, values in parse_qs(url.query).items()}
        if url.path == "/api/heatmap":
            self._heatmap(query)
        elif url.path == "/api/jobs":
            self._new_job(query.get("kind", ""))
        else:
            raise Refused(HTTPStatus.NOT_FOUND, "there is nothing at this address")

    def _delete(self, url: Any) -> None:
        self._check_key()
        job, _ = self._job(url.path)
        self.server.jobs.remove(job.name)
        self._send_json({})

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
        length = self._length(3 * width * height)
        if length != 3 * width * height:
            raise Refused(HTTPStatus.BAD_REQUEST, "these are not the pixels of such a picture")
        pixels = b"".join(self._pieces(length))
        rgb = np.frombuffer(pixels, np.uint8).reshape(height, width, 3)
        with self.server.network:
            logits = self.server.detector.heatmap_and_logits(rgb)[1]
        self._send(np.ascontiguousarray(logits, "<f4").tobytes(), "application/octet-stream")

    def _new_job(self, kind: str) -> None:
        """Start a task: a length, a description in JSON of that length, and the photographs."""
        options, jobs = self.server.options, self.server.jobs
        if kind not in TASKS:
            raise unknown_name("task", kind[:MAX_NAME_LENGTH], TASKS)
        left = self._length(int(options.max_task_mb * 1e6) + MAX_DESCRIPTION_BYTES)
        jobs.check_room()
        size = int.from_bytes(b"".join(self._pieces(min(4, left))))
        if not 0 < size <= min(MAX_DESCRIPTION_BYTES, left - 4):
            raise Refused(HTTPStatus.BAD_REQUEST, "the description of the task is missing")
        names, sizes, given = _described(b"".join(self._pieces(size)))
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
                    for piece in self._pieces(bytes_):
                        file.write(piece)
            job = jobs.start(folder, kind, list(zip(files, names, strict=True)), numbers)
        self._send_json({"job": job.name})

    def _length(self, largest: int) -> int:
        """Return the length of the request's body, which must be given and not too large."""
        text = self.headers.get("Content-Length", "")
        if not (text.isascii() and text.isdigit()) or "Transfer-Encoding" in self.headers:
            raise Refused(HTTPStatus.LENGTH_REQUIRED, "the length of the request is missing")
        if len(text) > 15 or int(text) > largest:
            raise Refused(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
                f"this is over {largest / 1e6:.3g} MB: give fewer or smaller photographs",
            )
        self.accepted_length = int(text)
        return self.accepted_length

    def _drain(self) -> None:
        """Read what is left of a refused request, as far as that is worth it."""
        text = self.headers.get("Content-Length", "")
        length = int(text) if text.isascii() and text.isdigit() and len(text) < 15 else 0
        left = min(length, max(self.accepted_length, DRAINED_BYTES)) - self.received
        with contextlib.suppress(Refused):
            for _ in self._pieces(max(0, left)):
                pass

    def _pieces(self, length: int) -> Any:
        """Yield so many bytes of the request's body."""
        while length:
            if time.monotonic() > self.deadline:
                raise Refused(HTTPStatus.REQUEST_TIMEOUT, "the request takes too long")
            piece = self.rfile.read1(min(length, PIECE_BYTES))
            if not piece:
                raise ConnectionError("the browser has ended the request")
            length -= len(piece)
            self.received += len(piece)
            yield piece

    def _refuse(self, status: HTTPStatus, sentence: str) -> None:
        self.close_connection = True
        self._drain()
        self._send_json({"error": sentence}, status)

    def _send_json(self, values: Any, status: HTTPStatus = HTTPStatus.OK) -> None:
        self._send(json.dumps(values).encode(), "application/json", status)

    def _send(self, content: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self._send_headers(len(content), kind, PAGE_POLICY, status)
        self.wfile.write(content)

    def _send_file(self, path: Path, policy: str) -> None:
        try:
            with path.open("rb") as file:
                kind = TYPES.get(path.suffix, "application/octet-stream")
                self._send_headers(path.stat().st_size, kind, policy)
                shutil.copyfileobj(file, self.wfile, PIECE_BYTES)
        except FileNotFoundError:
            raise Refused(HTTPStatus.NOT_FOUND, "there is no such file") from None

    def _send_headers(
        self, length: int, kind: str, policy: str, status: HTTPStatus = HTTPStatus.OK
    ) -> None:
        self.send_response(status)
        headers = {
            "Content-Type": f"{kind}; charset=utf-8" if kind.startswith("text/") else kind,
            "Content-Length": str(length),
            "Content-Security-Policy": policy,
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Cache-Control": "no-store",
            **({"Connection": "close"} if self.close_connection else {}),
        }
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()


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
