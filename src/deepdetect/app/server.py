"""Server of the page: for one user, only on the loopback address, without permanent storage.

Starlette and uvicorn handle HTTP. The server rejects requests that are too large, name another
host, come from another page, or lack the secret key. The key is new at each start.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import json
import mimetypes
import secrets
import shutil
import socket
import threading
from collections.abc import AsyncIterator, Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware, RequestResponseEndpoint
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from .. import __version__
from .._shared.errors import DeepDetectError, OptionError, unknown_name
from ..detector.detector import DeepDetect
from ..detector.points.descriptor import describe_learned
from ..detector.points.detection import rank_candidates
from ..detector.points.hessian_scales import build_scale_space
from ..features.keypoints import Keypoints
from ..io.image import MINIMUM_SIDE
from ..io.image_file import IMAGE_SUFFIXES
from .jobs import AppOptions, Jobs
from .tasks import TASKS, Order, SentImage

HOST = "127.0.0.1"
NAMES = (HOST, "localhost")
HTTP_PORT = 80
STATIC = Path(__file__).parent / "static"

CLOSE = {"Connection": "close"}
SHUTDOWN_S = 1
"""The server waits this many seconds for running requests at shutdown. Chosen by hand."""

CHECK_EVERY_S = 1.0
"""Seconds between two searches for tasks that take too long or are abandoned. Chosen by hand."""

MAX_IMAGE_PIXELS = 2_100_000
"""Maximum number of pixels of an image that the page sends. The page scales images to two
megapixels, but then rounds their sides to multiples of 8, which may enlarge them slightly."""

POINT_BYTES = 12
MAX_POINTS = 4000
"""Maximum number of points in a request, as the page's slider allows. Each point takes
`POINT_BYTES`: x, y and a size in float32."""

MAX_DESCRIPTION_BYTES = 1 << 18
"""Maximum bytes of the JSON with a task's options and the names and sizes of its images."""

MAX_NAME_LENGTH = 200

CANNOT_START = (
    "the task cannot start ({}): free some space and memory, or start deepdetect app again"
)

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; worker-src 'self'; "
        "style-src 'self'; img-src 'self' blob:; connect-src 'self'; frame-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
VIEWER_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "frame-ancestors 'self'; sandbox allow-scripts allow-downloads"
)
"""Content security policy for the viewer of a 3D model. The viewer is an HTML file with an inline
script, which the policy isolates from the page around the viewer."""


class AppServer:
    """Server of the page; at the end of a `with` block, it ends all tasks and removes all files.

    Attributes:
        key: secret key, new at each start, without which only the page itself is served.
        port: port that the server listens on.

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
        self.key = secrets.token_urlsafe(24)
        self._processors = threading.Lock()  # one image at a time, as each uses all processors
        self.jobs = Jobs(options)
        try:
            self._socket = socket.create_server((HOST, options.port))
        except OSError as error:
            self.jobs.close()
            raise OptionError(
                f"port {options.port} cannot be used ({error.strerror}): give another, or 0 for any"
            ) from None
        self.port = self._socket.getsockname()[1]
        self._server = uvicorn.Server(
            uvicorn.Config(
                self._routes(),
                ws="none",
                log_config=None,
                log_level="error",
                access_log=False,
                server_header=False,
                proxy_headers=False,
                timeout_graceful_shutdown=SHUTDOWN_S,
            )
        )

    def __enter__(self) -> AppServer:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        self.jobs.close()

    @property
    def address(self) -> str:
        """The address of the page, which contains the key."""
        return f"http://{HOST}:{self.port}/#key={self.key}"

    def serve_forever(self) -> None:
        """Answer requests until `stop` is called, or until Ctrl-C raises KeyboardInterrupt."""
        self._server.run(sockets=[self._socket])

    def stop(self) -> None:
        """End `serve_forever`, which runs in another thread."""
        self._server.should_exit = True

    def _routes(self) -> Starlette:
        # Another program may have changed the media type of .js files in Windows' registry.
        mimetypes.add_type("text/javascript", ".js")
        return Starlette(
            routes=[
                Route("/config.json", lambda _: JSONResponse(self._description())),
                Route("/api/heatmap", self._heatmap, methods=["POST"]),
                Route("/api/candidates", self._candidates, methods=["POST"]),
                Route("/api/descriptors", self._descriptors, methods=["POST"]),
                Route("/api/jobs", self._new_job, methods=["POST"]),
                Route("/api/jobs/{name}", self._job_state, methods=["GET"]),
                Route("/api/jobs/{name}", self._remove_job, methods=["DELETE"]),
                Route("/api/jobs/{name}/files/{file}", self._job_file),
                Mount("/", StaticFiles(directory=STATIC, html=True)),
            ],
            exception_handlers={
                HTTPException: lambda _, error: _refusal(error.status_code, error.detail),
                DeepDetectError: lambda _, error: _refusal(400, str(error)),
                TimeoutError: lambda *_: _refusal(408, "the request takes too long", CLOSE),
                MemoryError: lambda *_: _refusal(500, "too little memory: use smaller images"),
                OSError: lambda _, error: _refusal(400, CANNOT_START.format(error.strerror)),
                ClientDisconnect: lambda *_: _refusal(400, "the connection has ended"),
            },
            middleware=[Middleware(BaseHTTPMiddleware, dispatch=self._guard)],
            lifespan=self._watched,
        )

    async def _guard(self, request: Request, answer: RequestResponseEndpoint) -> Response:
        """Reject requests that name another host (DNS rebinding) or come from another page."""
        host = request.headers.get("Host")
        allowed = [f"{name}:{self.port}" for name in NAMES]
        if self.port == HTTP_PORT:  # browsers omit this port
            allowed += NAMES
        if host not in allowed:
            response = _refusal(421, "this address is not served here")
        elif request.headers.get("Origin", f"http://{host}") != f"http://{host}":
            response = _refusal(403, "only the page of deepdetect app may send this request")
        else:
            response = await answer(request)
        for name, value in HEADERS.items():
            response.headers.setdefault(name, value)
        return response

    @contextlib.asynccontextmanager
    async def _watched(self, _: Starlette) -> AsyncIterator[None]:
        async def watch() -> None:
            while True:
                await asyncio.sleep(min(CHECK_EVERY_S, self.options.abandoned_s / 4))
                await run_in_threadpool(self.jobs.end_overdue)

        watching = asyncio.create_task(watch())
        yield
        watching.cancel()

    def _description(self) -> dict[str, Any]:
        options = self.options
        names = ("title", "note", "options", "folder", "missing")
        tasks = [
            {
                "kind": kind,
                "files": [task.files[0], task.files[1] or options.max_files],
                **{name: getattr(task, name) for name in names},
            }
            for kind, task in TASKS.items()
        ]
        limits = {n: getattr(options, f"max_{n}") for n in ("file_mb", "task_mb", "files")}
        return {
            "engine": "python",
            "version": __version__,
            "tasks": tasks,
            "limits": limits,
            "suffixes": sorted(IMAGE_SUFFIXES),
        }

    def _check_key(self, request: Request) -> None:
        """Reject requests that lack the server's key, or come from another site."""
        given = request.headers.get("Authorization", "").removeprefix("Bearer ")
        if not hmac.compare_digest(given.encode(), self.key.encode()):
            raise HTTPException(
                401,
                "the key of this page is wrong: open the address that deepdetect app printed",
            )
        if request.headers.get("Sec-Fetch-Site", "same-origin") != "same-origin":
            raise HTTPException(403, "only the page of deepdetect app may send this request")

    @cached_property
    def _detector(self) -> DeepDetect:
        return DeepDetect(resolution="native")

    async def _heatmap(self, request: Request) -> Response:
        """Receive an image, (H, W, 3) uint8; send the network's logits for it, (H, W) float32."""

        def logits(rgb: np.ndarray, _: bytes) -> np.ndarray:
            return self._detector.heatmap_and_logits(rgb)[1]

        return await self._answer(request, 3, logits)

    async def _candidates(self, request: Request) -> Response:
        """Receive the grey values of an image, (H, W) uint8; send its candidate points.

        The answer is (4, N) float32 with rows x, y, sigma and logit, the best candidate first.
        """

        def ranked(gray: np.ndarray, _: bytes) -> np.ndarray:
            candidates, logits = rank_candidates(build_scale_space(gray[..., 0]))
            columns = np.column_stack([candidates.xy, candidates.sigma_px, logits])
            return columns[np.argsort(candidates.rank)].T

        return await self._answer(request, 1, ranked)

    async def _descriptors(self, request: Request) -> Response:
        """Receive an image and points; send learned descriptors of the points at angle 0.

        The image is (H, W) uint8. The points are (N, 2) positions, then (N,) sizes, in float32. The
        descriptors are (N, 64) float32.
        """

        def described(gray: np.ndarray, numbers: bytes) -> np.ndarray:
            xy, sizes = np.split(np.frombuffer(numbers, "<f4"), [len(numbers) // POINT_BYTES * 2])
            size, upright = (gray.shape[1], gray.shape[0]), np.zeros(len(sizes))
            points = Keypoints(xy.reshape(-1, 2), upright, size, sizes=sizes, angles=upright)
            descriptors = describe_learned(gray[..., 0], points).descriptors
            assert descriptors is not None
            return descriptors

        return await self._answer(request, 1, described, MAX_POINTS)

    async def _answer(
        self,
        request: Request,
        channels: int,
        compute: Callable[[np.ndarray, bytes], np.ndarray],
        max_points: int = 0,
    ) -> Response:
        """Receive an image and at most `max_points` points; send the float32 result of `compute`.

        `compute` gets the image as (H, W, `channels`) uint8, and the bytes of the points.
        """
        self._check_key(request)
        try:
            width, height = (int(request.query_params[name]) for name in ("width", "height"))
        except (KeyError, ValueError):
            raise HTTPException(400, "the size of the image is missing") from None
        if min(width, height) < MINIMUM_SIDE or width * height > MAX_IMAGE_PIXELS:
            raise HTTPException(400, f"an image of {width}x{height} pixels is not accepted here")
        length = channels * width * height
        points = _body_length(request, length + POINT_BYTES * max_points) - length
        if points < 0 or points % POINT_BYTES:
            raise HTTPException(400, "the request's length does not fit an image of this size")
        async with asyncio.timeout(self.options.max_request_s):
            body = await request.body()
        pixels = np.frombuffer(body, np.uint8, length).reshape(height, width, channels)

        def answer() -> bytes:
            with self._processors:
                return compute(pixels, body[length:]).astype("<f4").tobytes()

        return Response(await run_in_threadpool(answer), media_type="application/octet-stream")

    async def _new_job(self, request: Request) -> Response:
        """Start a task. The body is the length of a JSON text (4 bytes), the text, and images."""
        self._check_key(request)
        kind, options = request.query_params.get("kind", ""), self.options
        if kind not in TASKS:
            raise unknown_name("task", kind[:MAX_NAME_LENGTH], TASKS)
        left = _body_length(request, int(options.max_task_mb * 1e6) + MAX_DESCRIPTION_BYTES)
        self.jobs.check_room()
        async with asyncio.timeout(options.max_request_s):
            return await self._received(kind, _Body(request), left)

    async def _received(self, kind: str, body: _Body, left: int) -> Response:
        options = self.options
        size = int.from_bytes(await body.read(min(4, left)))
        if not 0 < size <= min(MAX_DESCRIPTION_BYTES, left - 4):
            raise HTTPException(400, "the description of the task is missing")
        files, given = _described(await body.read(size))
        if len(files) > options.max_files:
            raise OptionError(
                f"{len(files)} images exceed the limit of {options.max_files}: raise --max-files"
            )
        for name, length in files:
            if length > options.max_file_mb * 1e6:
                raise OptionError(f"{name} is over {options.max_file_mb:g} MB: make it smaller")
        if sum(length for _, length in files) != left - 4 - size:
            raise HTTPException(400, "the image files do not have the stated lengths")
        numbers = TASKS[kind].check(len(files), given)
        with contextlib.ExitStack() as made:
            folder = self.jobs.new_folder()
            made.callback(shutil.rmtree, folder, ignore_errors=True)
            images = []
            for number, (name, length) in enumerate(files):
                suffix = Path(name).suffix.lower()
                suffix = suffix if suffix in IMAGE_SUFFIXES else ""
                images.append(SentImage(folder / f"{number:04d}{suffix}", name))
                with images[-1].path.open("xb") as file:
                    async for piece in body.pieces(length):
                        file.write(piece)
            order = Order(kind, images, numbers, folder, options.max_megapixels)
            job = self.jobs.start(order)
            made.pop_all()
        return JSONResponse({"job": job.name})

    def _job(self, request: Request) -> Any:
        job = self.jobs.find(request.path_params["name"])
        if job is None:
            raise HTTPException(404, "there is no such task: it may have been removed")
        return job

    def _job_state(self, request: Request) -> Response:
        self._check_key(request)
        return JSONResponse(self._job(request).state)

    def _job_file(self, request: Request) -> Response:
        path = self._job(request).file(request.path_params["file"])
        if path is None:
            raise HTTPException(404, "there is no such file")
        if path.suffix == ".html":  # an iframe sends no key, but the task's name is secret
            return FileResponse(path, headers={"Content-Security-Policy": VIEWER_POLICY})
        self._check_key(request)
        return FileResponse(path)

    def _remove_job(self, request: Request) -> Response:
        self._check_key(request)
        self.jobs.remove(self._job(request).name)
        return JSONResponse({})


class _Body:
    def __init__(self, request: Request) -> None:
        self._chunks, self._read = request.stream(), b""

    async def pieces(self, length: int) -> AsyncIterator[bytes]:
        while length:
            if not self._read:
                self._read = await anext(self._chunks)
            piece, self._read = self._read[:length], self._read[length:]
            length -= len(piece)
            yield piece

    async def read(self, length: int) -> bytes:
        return b"".join([piece async for piece in self.pieces(length)])


def _refusal(status: int, sentence: str, headers: dict[str, str] | None = None) -> Response:
    return JSONResponse({"error": sentence}, status, headers)


def _body_length(request: Request, largest: int) -> int:
    text = request.headers.get("Content-Length")
    if text is None:
        raise HTTPException(411, "the length of the request is missing")
    if int(text) > largest:
        raise HTTPException(
            413, f"the request exceeds {largest / 1e6:.3g} MB: give fewer or smaller images"
        )
    return int(text)


def _described(text: bytes) -> tuple[list[tuple[str, int]], dict[str, object]]:
    """Read the names and lengths of images, and the options, from a description in JSON."""
    try:
        values = json.loads(text)
        files = [(_clean(str(one["name"])), one["size"]) for one in values["files"]]
        if not all(type(length) is int and length >= 0 for _, length in files):
            raise ValueError
        return files, dict(values["options"])
    except (ValueError, TypeError, KeyError, RecursionError):
        raise HTTPException(400, "the description of the task is damaged") from None


def _clean(name: str) -> str:
    """Return a name that can be displayed: not too long, and on one line."""
    return "".join(c if c.isprintable() else "_" for c in name[-MAX_NAME_LENGTH:]) or "image"
