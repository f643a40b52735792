"""A running server, requests to it as any program could make them, and node for the modules."""

from __future__ import annotations

import http.client
import json
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from email.message import Message
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepdetect.app.jobs import AppOptions
from deepdetect.app.server import STATIC, AppServer


@dataclass(frozen=True)
class Answer:
    """What came back."""

    status: int
    headers: Message
    content: bytes

    @property
    def values(self) -> Any:
        return json.loads(self.content)


class Client:
    """Asks a server, with the headers that the page sends unless others are given."""

    def __init__(self, server: AppServer) -> None:
        self.server = server
        self.host = f"127.0.0.1:{server.port}"

    def ask(
        self,
        method: str,
        path: str,
        body: Any = None,
        headers: dict[str, str | None] | None = None,
    ) -> Answer:
        given: dict[str, str | None] = {
            "Host": self.host,
            "Authorization": f"Bearer {self.server.key}",
            **(headers or {}),
        }
        connection = http.client.HTTPConnection("127.0.0.1", self.server.port, timeout=60)
        connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        if body is not None and "Content-Length" not in given:
            given["Content-Length"] = str(len(body))
        for name, value in given.items():
            if value is not None:
                connection.putheader(name, value)
        connection.endheaders(body)
        response = connection.getresponse()
        answer = Answer(response.status, response.headers, response.read())
        connection.close()
        return answer

    def start(self, kind: str, files: list[tuple[str, bytes]], **options: Any) -> Answer:
        return self.ask("POST", f"/api/jobs?kind={kind}", packed(files, options))

    def wait(self, job: str, seconds: float = 120) -> dict[str, Any]:
        """Return the state of a task when it has ended."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            state = self.ask("GET", f"/api/jobs/{job}").values
            if state["state"] != "running":
                return state
            time.sleep(0.1)
        raise AssertionError("the task does not end")


def packed(files: list[tuple[str, bytes]], options: Any) -> bytes:
    """Make the body of a request for a task."""
    listed = [{"name": name, "size": len(content)} for name, content in files]
    description = json.dumps({"files": listed, "options": options}).encode()
    return len(description).to_bytes(4) + description + b"".join(content for _, content in files)


@pytest.fixture
def serve(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., tuple[Client, Path]]]:
    """Start a server; return a client, and the folder of all its temporary files."""
    import tempfile

    started = []

    def start(**options: Any) -> tuple[Client, Path]:
        folder = tmp_path / f"temporary{len(started)}"
        folder.mkdir()
        monkeypatch.setattr(tempfile, "tempdir", str(folder))
        server = AppServer(AppOptions(port=0, **options))
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        started.append((server, thread, folder))
        return Client(server), folder

    yield start
    for server, thread, folder in started:
        with server:
            server.stop()
            thread.join(timeout=60)
        assert list(folder.iterdir()) == []


READ = """
import { readFileSync, writeFileSync } from "node:fs";
const [given, made] = process.argv.slice(2);
const { width, height, ...values } = JSON.parse(readFileSync(given + ".json"));
const bytes = new Uint8Array(readFileSync(given)).buffer; // small files share a buffer
"""


@pytest.fixture
def run_node(tmp_path: Path) -> Any:
    """Run a script with an array and values; return the array of float64 that it writes."""
    if shutil.which("node") is None:
        pytest.skip("needs node")

    def run(imports: str, script: str, array: np.ndarray, **values: Any) -> np.ndarray:
        given, made = tmp_path / "given.bin", tmp_path / "made.bin"
        array.tofile(given)
        (tmp_path / "given.bin.json").write_text(json.dumps(values), encoding="utf-8")
        (tmp_path / "script.mjs").write_text(
            imports.replace("@", (STATIC / "js").as_uri()) + READ + script, encoding="utf-8"
        )
        words = ["node", str(tmp_path / "script.mjs"), str(given), str(made)]
        ended = subprocess.run(words, capture_output=True, text=True)
        assert ended.returncode == 0, ended.stderr
        return np.fromfile(made, np.float64)

    return run
