"""HTTP as the page's server speaks it: on the loopback address only, and for its own page.

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
import time
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import SplitResult, urlsplit

from .._shared.errors import DeepDetectError, OptionError

HOST = "127.0.0.1"
NAMES = (HOST, "localhost")
HTTP_PORT = 80

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


class GuardedServer(ThreadingHTTPServer):
    """Listens at a port of the loopback address.

    Args:
        port: 0 for any that is free.
        handler: of the requests.
        max_request_s: time for which a request may stand still.

    Attributes:
        key: the secret of this start, which every request but those for the page must have.

    Raises:
        OptionError: the port is taken.
    """

    daemon_threads = True

    def __init__(self, port: int, handler: type[GuardedHandler], max_request_s: float) -> None:
        self.max_request_s = max_request_s
        self.key = secrets.token_urlsafe(24)
        try:
            super().__init__((HOST, port), handler)
        except OSError as error:
            raise OptionError(
                f"port {port} cannot be used ({error.strerror}): give another `port`, or 0 "
                "for any that is free"
            ) from None

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of connections that the browser has ended."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


class GuardedHandler(BaseHTTPRequestHandler):
    """Receives the requests of one connection, and sends what its methods `do_GET`... answer."""

    server: GuardedServer
    protocol_version = "HTTP/1.1"

    def setup(self) -> None:
        super().setup()
        self.connection.settimeout(self.server.max_request_s)
        # What is answered is short, and waited for.
        self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, True)

    def version_string(self) -> str:
        return "deepdetect"

    def log_message(self, format: str, *args: Any) -> None:
        """Keep no log."""

    def answer(self, method: Any) -> None:
        """Answer by a method that is given the address, or say in one sentence why not."""
        self.received, self.accepted_length = 0, 0
        self.deadline = time.monotonic() + SLOWEST * self.server.max_request_s
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

    def check_key(self) -> None:
        """Refuse requests without the key of this start."""
        given = self.headers.get("Authorization", "").removeprefix("Bearer ")
        if not hmac.compare_digest(given.encode(), self.server.key.encode()):
            raise Refused(
                HTTPStatus.UNAUTHORIZED,
                "the key of this page is not that of deepdetect app: open the address that it has "
                "printed",
            )
        if self.headers.get("Sec-Fetch-Site", "same-origin") != "same-origin":
            raise Refused(HTTPStatus.FORBIDDEN, "only the page of deepdetect app may ask this")

    def body_length(self, largest: int) -> int:
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
            for _ in self.pieces(max(0, left)):
                pass

    def pieces(self, length: int) -> Any:
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
        self.send_json({"error": sentence}, status)

    def send_json(self, values: Any, status: HTTPStatus = HTTPStatus.OK) -> None:
        """Answer values as JSON."""
        self.send(json.dumps(values).encode(), "application/json", status)

    def send(self, content: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        """Answer bytes of this media type."""
        self._send_headers(len(content), kind, PAGE_POLICY, status)
        self.wfile.write(content)

    def send_file(self, path: Path, policy: str) -> None:
        """Answer a file, with what it may load and run.

        Raises:
            Refused: there is none.
        """
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
