"""Nothing but `deepdetect dev datasets get` asks for the network."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import deepdetect

ROOT = Path(deepdetect.__path__[0])
FOR_THE_NETWORK = {
    *("aiohttp", "asyncio", "ftplib", "http", "httpx", "huggingface_hub", "pooch", "requests"),
    *("smtplib", "socket", "socketserver", "ssl", "telnetlib", "urllib", "urllib3", "webbrowser"),
    *("wget", "xmlrpc"),
}

# Every process of the test begins with it. What is written down counts even if the error is caught.
GUARD = """
import os, sys

def refuse(event, arguments):
    if event in ("socket.connect", "socket.getaddrinfo", "socket.gethostbyname",
                 "socket.gethostbyaddr", "socket.sendto", "socket.sendmsg", "urllib.Request"):
        with open(os.environ["NETWORK_LOG"], "a") as file:
            file.write(f"{event} {arguments}\\n")
        raise RuntimeError("the network is forbidden here")

sys.addaudithook(refuse)
"""

FUNCTIONS = """
import contextlib
from deepdetect import (
    DeepDetect, DeepDetectError, PointDetector, load_image, match_images, reconstruct, register
)
from deepdetect_lab.labels import LabelOptions, fuse
from deepdetect.io.image import luma

if __name__ == "__main__":
    left, right = load_image("left.png"), load_image("right.png")
    detector = DeepDetect()
    assert len(detector.detect(left)) and len(PointDetector(50).detect(left))
    assert len(match_images(left, right, detector))
    with contextlib.suppress(DeepDetectError):  # little can be seen in so small images
        register(left, right, detector)
    with contextlib.suppress(DeepDetectError):
        reconstruct(left, right, focal_px=200.0)
    assert fuse(luma(left), LabelOptions()).mask.any()
"""


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Where attempts are noted; two small views of a scene are beside it."""
    from PIL import Image
    from skimage import data

    for name, image in zip(("left", "right"), data.stereo_motorcycle()[:2], strict=True):
        Image.fromarray(np.ascontiguousarray(image[100:228, 300:460])).save(
            tmp_path / f"{name}.png"
        )
    (tmp_path / "guard").mkdir()
    (tmp_path / "guard" / "sitecustomize.py").write_text(GUARD)
    return tmp_path / "log.txt"


def run(log: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    paths = os.pathsep.join([str(log.parent / "guard"), *sys.path])
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=log.parent,
        env={**os.environ, "PYTHONPATH": paths, "NETWORK_LOG": str(log)},
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_the_guard_notices_attempts(log: Path) -> None:
    code = "import contextlib, urllib.request\n"
    code += "with contextlib.suppress(Exception): urllib.request.urlopen('http://127.0.0.1:9')"
    assert run(log, "-c", code).returncode == 0
    assert "urllib.Request" in log.read_text()


def test_commands_connect_to_nothing(log: Path) -> None:
    code = "import sys; from deepdetect.cli import main\n"
    code += "sys.exit(any(main(words.split()) for words in sys.argv[1:]))"
    commands = (
        "detect left.png right.png -o out",
        "match left.png right.png -o out",
        "label left.png right.png -o masks --workers 2",
        "dev datasets list",
    )
    result = run(log, "-c", code, *commands)
    assert result.returncode == 0, result.stderr
    assert "coco" in result.stdout, "the last one has run, too"
    assert not log.exists(), log.read_text()


def test_only_downloads_and_the_page_import_what_connects() -> None:
    found = set()
    for path in ROOT.rglob("*.py"):
        text = path.read_text("utf-8")
        if not any(name in text for name in FOR_THE_NETWORK):
            continue
        for node in ast.walk(ast.parse(text)):
            names: list[str] = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and not node.level:
                names = [node.module or ""]
            if FOR_THE_NETWORK & {name.partition(".")[0] for name in names}:
                found.add(path.relative_to(ROOT).as_posix())
    # The page's server listens, on the loopback address only; its command can open a browser.
    page = {"app/server.py", "cli/app.py", "cli/view.py"}
    assert found == page
