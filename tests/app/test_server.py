"""Who is answered, how large and slow a request may be, and that nothing is kept."""

from __future__ import annotations

import io
import socket
import subprocess
import sys
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from deepdetect import DeepDetect, PointDetector
from deepdetect.app import jobs
from deepdetect.app.jobs import Job
from deepdetect.detector.points.descriptor import describe_learned
from deepdetect.detector.points.detection import detect_points, rank_candidates
from deepdetect.detector.points.hessian_scales import build_scale_space
from deepdetect.features.learned import turn_descriptors
from deepdetect.io.image import luma

from .conftest import Client, packed


def encoded(rgb: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(rgb).save(file, "png")
    return file.getvalue()


def folders(temporary: Path) -> list[Path]:
    """Return the folders of tasks."""
    return [task for server in temporary.iterdir() for task in server.iterdir()]


def test_the_page_is_served_with_a_strict_policy_at_the_loopback_address(serve: Any) -> None:
    client, _ = serve()
    assert client.server._socket.getsockname()[0] == "127.0.0.1"
    assert client.server.address.startswith(f"http://{client.host}/#key=")
    for path in ("/", "/config.json", "/js/main.js", "/examples/coffee.jpg"):
        answer = client.ask("GET", path, headers={"Authorization": None})
        assert answer.status == 200
        policy = answer.headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy
        assert "http" not in policy
        assert "unsafe-inline" not in policy
        assert "Access-Control-Allow-Origin" not in answer.headers
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
    outside = ("/../server.py", "/js/../../server.py", "/%2e%2e/server.py", "//etc/passwd")
    for path in (*outside, "/js", "/x"):
        assert client.ask("GET", path).status == 404


def test_other_hosts_and_origins_are_refused(serve: Any) -> None:
    """What DNS rebinding and other pages would send."""
    client, _ = serve()
    hosts = (
        "example.org",
        "127.0.0.1",
        "127.0.0.1:1",
        f"127.0.0.1.example.org:{client.server.port}",
    )
    for host in (*hosts, ""):
        for path in ("/", "/config.json", "/api/jobs/x"):
            assert client.ask("GET", path, headers={"Host": host}).status == 421
    assert client.ask("GET", "/", headers={"Host": None}).status == 400  # by uvicorn
    for origin in ("http://example.org", "null", f"https://{client.host}", "http://127.0.0.1"):
        headers = {"Origin": origin}
        assert client.ask("POST", "/api/jobs?kind=match", b"", headers).status == 403
        assert client.ask("GET", "/config.json", headers=headers).status == 403
    right = {"Origin": f"http://{client.host}"}
    assert client.ask("GET", "/config.json", headers=right).status == 200


def test_the_key_is_needed_and_a_request_of_the_page(serve: Any) -> None:
    client, temporary = serve()
    for key in (None, "Bearer ", "Bearer wrong", "Bearer ü".encode().decode("latin1")):
        headers = {"Authorization": key}
        answer = client.ask("POST", "/api/jobs?kind=match", b"abc", headers)
        assert answer.status == 401
        assert client.ask("POST", "/api/heatmap?width=16&height=16", b"", headers).status == 401
    for site in ("cross-site", "same-site", "none"):
        headers = {"Sec-Fetch-Site": site}
        assert client.ask("POST", "/api/jobs?kind=match", b"", headers).status == 403
    assert folders(temporary) == []


def test_a_body_that_nobody_reads_is_no_request(serve: Any) -> None:
    client, _ = serve()
    port = client.server.port
    inner = f"GET /icon.svg HTTP/1.1\r\nHost: {client.host}\r\n\r\n"
    outer = (
        f"GET /config.json HTTP/1.1\r\nHost: {client.host}\r\nConnection: close\r\n"
        f"Content-Length: {len(inner)}\r\n\r\n"
    )
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.settimeout(30)
        connection.sendall((outer + inner).encode())
        answer = b""
        while piece := connection.recv(1 << 16):
            answer += piece
    assert answer.count(b"HTTP/1.1 ") == 1


def test_the_logits_are_those_of_the_package(serve: Any, photo: np.ndarray) -> None:
    client, _ = serve()
    rgb = np.ascontiguousarray(photo[:100, :91])
    answer = client.ask("POST", "/api/heatmap?width=91&height=100", rgb.tobytes())
    assert answer.status == 200
    found = np.frombuffer(answer.content, "<f4").reshape(100, 91)
    np.testing.assert_array_equal(found, DeepDetect().heatmap_and_logits(rgb)[1])


def test_the_candidates_are_those_of_the_package(serve: Any, photo: np.ndarray) -> None:
    client, _ = serve()
    gray = luma(np.ascontiguousarray(photo[:100, :91]))
    answer = client.ask("POST", "/api/candidates?width=91&height=100", gray.tobytes())
    assert answer.status == 200
    found = np.frombuffer(answer.content, "<f4").reshape(4, -1)
    candidates, logits = rank_candidates(build_scale_space(gray))
    order = np.argsort(candidates.rank)
    np.testing.assert_array_equal(found[:2].T, candidates.xy[order].astype(np.float32))
    np.testing.assert_array_equal(found[2], candidates.sigma_px[order].astype(np.float32))
    np.testing.assert_array_equal(found[3], logits[order])


def test_the_descriptors_are_those_of_the_package(serve: Any, photo: np.ndarray) -> None:
    client, _ = serve()
    gray = luma(np.ascontiguousarray(photo[:100, :91]))
    points = describe_learned(gray, detect_points(gray, 20))
    assert points.sizes is not None
    body = gray.tobytes() + points.xy.tobytes() + points.sizes.tobytes()
    answer = client.ask("POST", "/api/descriptors?width=91&height=100", body)
    found = np.frombuffer(answer.content, "<f4").reshape(20, 64)
    assert points.descriptors is not None
    assert points.angles is not None
    expected = turn_descriptors(points.descriptors, points.angles)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    wrong = gray.tobytes() + np.full(3, np.nan, "f4").tobytes()
    for refused in (body[:-4], wrong):
        answer = client.ask("POST", "/api/descriptors?width=91&height=100", refused)
        assert answer.status == 400


@pytest.mark.parametrize(
    ("query", "length", "status"),
    [
        ("width=16&height=16", 767, 400),
        ("width=16&height=16", 769, 413),
        ("width=9999&height=9999", 100, 400),
        ("", 768, 400),
    ],
)
def test_a_wrong_heat_map_is_refused(query: str, length: int, status: int, serve: Any) -> None:
    client, _ = serve()
    answer = client.ask("POST", f"/api/heatmap?{query}", bytes(length))
    assert answer.status == status
    assert answer.values["error"]


def test_a_body_without_length_is_refused(serve: Any) -> None:
    client, _ = serve()
    chunked = {"Content-Length": None, "Transfer-Encoding": "chunked"}
    assert client.ask("POST", "/api/jobs?kind=match", b"0\r\n\r\n", chunked).status == 411
    for length in ("-1", "1e3"):
        headers = {"Content-Length": length}
        assert client.ask("POST", "/api/jobs?kind=match", b"", headers).status == 400


def test_sizes_are_limited(serve: Any, photo: np.ndarray) -> None:
    client, temporary = serve(max_file_mb=0.01, max_task_mb=0.015, max_files=3)
    pixel = ("a.png", b"x")
    many = [("a.png", bytes(9_000))] * 60
    for files in ([("big.png", bytes(10_001))] * 2, [pixel] * 4, many):
        assert client.start("stitch", files).status in (400, 413)
    assert folders(temporary) == []


def test_too_many_pixels_are_refused_before_they_are_decoded(serve: Any) -> None:
    client, _ = serve(max_megapixels=0.05)
    large = ("large.png", encoded(np.zeros((300, 300, 3), np.uint8)))
    job = client.start("folder-keypoints", [large]).values["job"]
    state = client.wait(job)
    assert state["state"] == "failed"
    assert "300x300" in state["error"]
    assert "/" not in state["error"]  # no path of this computer


def test_a_damaged_task_is_refused(serve: Any) -> None:
    client, temporary = serve()
    files = [("a.png", b"abc"), ("b.png", b"de")]
    for body in (
        b"",
        (2**31).to_bytes(4) + b"{}",
        (4).to_bytes(4) + b"null",
        packed(files, {}) + b"x",
        packed(files, {}).replace(b'"size": 3', b'"size":-3'),
        packed(files, [1]),
    ):
        assert client.ask("POST", "/api/jobs?kind=match", body).status == 400
    assert folders(temporary) == []


def test_a_task_that_does_not_fit_is_refused(serve: Any) -> None:
    client, temporary = serve()
    for kind, count, options in (
        ("mach", 2, {}),
        ("match", 3, {}),
        ("stitch", 1, {}),
        ("match", 2, {"focal_px": 3}),
        ("reconstruct", 2, {"focal_px": "3"}),
        ("reconstruct", 2, {"focal_px": 10**400}),
        ("folder-keypoints", 0, {}),
    ):
        answer = client.start(kind, [("a.png", b"x")] * count, **options)
        assert answer.status == 400, kind
    assert folders(temporary) == []


def test_a_task_is_done_and_forgotten(serve: Any, photo: np.ndarray) -> None:
    client, temporary = serve()
    files = [("../../etc/a b.png", encoded(photo)), ("x/\n.txt", b"no picture")]
    job = client.start("folder-keypoints", files, max_keypoints=50)
    assert job.status == 400  # the number is not an option of the page
    job = client.start("folder-keypoints", files).values["job"]
    state = client.wait(job)
    assert state["state"] == "done", state
    assert state["numbers"]["Images"] == "1 of 2"
    address = f"/api/jobs/{job}/files/keypoints.zip"
    assert client.ask("GET", address, headers={"Authorization": None}).status == 401
    answer = client.ask("GET", address)
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert sorted(archive.namelist()) == ["a b.csv", "failures.txt"]
        table = archive.read("a b.csv").decode().splitlines()
    expected = PointDetector().detect(photo)
    assert len(table) == len(expected) + 1
    for name in ("task.json", "../task.json", "../0000.png", "failures.txt", ""):
        assert client.ask("GET", f"/api/jobs/{job}/files/{name}").status == 404
    assert len(folders(temporary)) == 1
    assert client.ask("DELETE", f"/api/jobs/{job}").status == 200
    assert folders(temporary) == []
    assert client.ask("GET", address).status == 404


def noise(count: int) -> list[tuple[str, bytes]]:
    """Return images that take seconds each."""
    rgb = np.random.default_rng(0).integers(0, 256, (600, 600, 3)).astype(np.uint8)
    content = encoded(rgb)
    return [(f"{number}.png", content) for number in range(count)]


def long_task(client: Client) -> str:
    """Start a task that would take minutes."""
    return client.start("folder-keypoints", noise(60)).values["job"]


def test_a_task_is_cancelled(serve: Any) -> None:
    client, temporary = serve(max_tasks=1)
    job = long_task(client)
    process = client.server.jobs.find(job).process
    assert client.start("folder-keypoints", [("a.png", b"x")]).status == 400
    assert client.ask("DELETE", f"/api/jobs/{job}").status == 200
    assert not process.is_alive()
    assert folders(temporary) == []
    assert client.start("folder-keypoints", [("a.png", b"x")]).status == 200


def test_a_task_that_takes_too_long_is_ended(serve: Any) -> None:
    client, _ = serve(max_task_s=0.5)
    assert client.wait(long_task(client))["state"] == "failed"


def test_a_task_that_nobody_asks_for_is_forgotten(serve: Any) -> None:
    client, temporary = serve(abandoned_s=0.5)
    long_task(client)
    until = time.monotonic() + 30
    while folders(temporary) and time.monotonic() < until:
        time.sleep(0.1)
    assert folders(temporary) == []


def test_a_process_that_dies_is_said_in_one_sentence(serve: Any) -> None:
    client, _ = serve()
    job = long_task(client)
    client.server.jobs.find(job).process.kill()
    assert client.wait(job)["state"] == "failed"


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs /proc to see what runs")
def test_a_worker_ends_with_the_server(tmp_path: Path) -> None:
    for name, content in noise(60):
        (tmp_path / name).write_bytes(content)
    code = (
        "import os, pathlib, sys\n"
        "from deepdetect.app.jobs import Job\n"
        "from deepdetect.app.tasks import Order, SentImage\n"
        "if __name__ == '__main__':\n"
        "    folder = pathlib.Path(sys.argv[1])\n"
        "    images = [SentImage(path, path.name) for path in folder.glob('*.png')]\n"
        "    job = Job(Order('folder-keypoints', images, {}, folder, 100))\n"
        "    while job.state['stage'] == 'starting':\n"
        "        pass\n"
        "    print(job.process.pid, flush=True)\n"
        "    os._exit(1)\n"
    )
    (tmp_path / "server.py").write_text(code)
    words = [sys.executable, str(tmp_path / "server.py"), str(tmp_path)]
    pid = subprocess.run(words, stdout=subprocess.PIPE, text=True).stdout.strip()
    status = Path(f"/proc/{pid}/stat")
    until = time.monotonic() + 60
    while status.exists() and status.read_text().rsplit(")", 1)[1].split()[0] != "Z":
        assert time.monotonic() < until
        time.sleep(0.1)


def test_a_body_that_trickles_is_ended(serve: Any) -> None:
    client, _ = serve(max_request_s=0.1)
    head = (
        f"POST /api/heatmap?width=1000&height=1000 HTTP/1.1\r\nHost: {client.host}\r\n"
        f"Authorization: Bearer {client.server.key}\r\nContent-Length: 3000000\r\n\r\n"
    )
    with socket.create_connection(("127.0.0.1", client.server.port)) as connection:
        connection.sendall(head.encode())

        def trickle() -> None:
            for _ in range(600):
                connection.sendall(b"x")
                time.sleep(0.05)

        with pytest.raises(ConnectionError):
            trickle()


def test_images_that_cannot_be_written_are_said(
    serve: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    client, temporary = serve()
    (home,) = temporary.iterdir()
    home.rmdir()  # as programs do that clean up
    answer = client.start("folder-keypoints", [("a.png", b"x")])
    assert answer.status == 400
    assert capfd.readouterr().err == ""


def test_the_last_place_is_taken_once(serve: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(*given: Any) -> Job:
        time.sleep(0.3)  # so that the requests overlap
        return Job(*given)

    monkeypatch.setattr(jobs, "Job", slow)
    client, _ = serve(max_tasks=1)
    with ThreadPoolExecutor(3) as pool:
        asked = [pool.submit(client.start, "folder-keypoints", noise(30)) for _ in range(3)]
        found = sorted(one.result().status for one in asked)
    assert found == [200, 400, 400]


def test_a_full_disk_is_said_by_the_task(tmp_path: Path) -> None:
    code = (
        "import errno, multiprocessing, pathlib, sys, types\n"
        "from deepdetect.app import jobs\n"
        "def full(*given):\n    raise OSError(errno.ENOSPC, 'No space left on device')\n"
        "jobs.TASKS['match'] = types.SimpleNamespace(run=full)\n"
        "receiver, sender = multiprocessing.Pipe(duplex=False)\n"
        "jobs.run_task(sender, jobs.Order('match', [], {}, pathlib.Path(sys.argv[1]), 1))\n"
        "pathlib.Path(sys.argv[1], 'told').write_text(receiver.recv()['error'])\n"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True)
    assert "No space left on device" in (tmp_path / "told").read_text()
