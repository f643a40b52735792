"""Whatever a user gets wrong ends with one sentence and exit code 2, and without a traceback."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from deepdetect.detector.pretrained import pretrained_weights

from .conftest import one_sentence


@pytest.fixture
def bad(tmp_path: Path, photos: Path) -> Path:
    """A folder of things that are no fit input."""
    folder = tmp_path / "bad"
    (folder / "empty").mkdir(parents=True)
    png = (photos / "left.png").read_bytes()
    (folder / "good.png").write_bytes(png)
    (folder / "truncated.png").write_bytes(png[: len(png) // 2])
    (folder / "text.png").write_text("I am no image")
    (folder / "weights.onnx").write_text("I am no network")
    (folder / "weights.safetensors").write_bytes(b"\x08\x00\x00\x00\x00\x00\x00\x00{}      ")
    (folder / "weights.pth").write_bytes(b"\x80\x04K\x01.")
    Image.new("L", (15, 40)).save(folder / "small.png")
    sphere = b'<rdf:Description GPano:ProjectionType="equirectangular"/>'
    for name in "ab":
        Image.new("RGB", (64, 32)).save(folder / f"sphere-{name}.jpg", xmp=sphere)
    (folder / "matrix.txt").write_text("1 2\n3 4\n")
    (folder / "archive.zip").write_bytes(b"PK\3\4" + bytes(300))
    (folder / "video.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(200))
    return folder


CASES = {
    "missing image": "detect {bad}/nothing.png",
    "truncated png": "detect {bad}/truncated.png",
    "no image": "detect {bad}/text.png",
    "empty folder": "detect {bad}/empty",
    "matching panoramas": "match {bad}/sphere-a.jpg {bad}/sphere-b.jpg",
    "panoramas by descriptors": "match {bad}/sphere-a.jpg {bad}/sphere-b.jpg --unguided",
    "pose of panoramas": "pose {bad}/sphere-a.jpg {bad}/sphere-b.jpg --focal 50",
    "stitching panoramas": "stitch {bad}/sphere-a.jpg {bad}/sphere-b.jpg -o p.jpg",
    "depth of panoramas": "reconstruct {bad}/sphere-a.jpg {bad}/sphere-b.jpg --focal 50",
    "small image": "detect {bad}/small.png",
    "missing weights": "detect {bad}/good.png --weights {bad}/no.onnx",
    "text as weights": "detect {bad}/good.png --weights {bad}/weights.onnx",
    "other tensors": "detect {bad}/good.png --weights {bad}/weights.safetensors",
    "a pickle": "detect {bad}/good.png --weights {bad}/weights.pth",
    "device": "detect {bad}/good.png --device CUDA",
    "stereo without a scene": "dev evaluate-stereo {bad}/empty",
    "output is a file": "detect {bad}/good.png -o {bad}/text.png",
    "ignore mask": "detect {bad}/good.png --ignore {bad}/small.png",
    "seed": "match {bad}/good.png {bad}/good.png --seed -1",
    "essential without cameras": "match {bad}/good.png {bad}/good.png --model essential",
    "homography": "match {bad}/good.png {bad}/good.png --homography {bad}/matrix.txt",
    "train nothing": "train {bad}/empty -o {bad}/out",
    "label settings": "label {bad}/good.png -o {bad}/out --label-settings {bad}/no.toml",
    "evaluate nothing": "dev evaluate {bad}/empty",
    "three images to register": "register {bad}/good.png {bad}/good.png {bad}/good.png",
    "three images for a pose": "pose {bad}/good.png {bad}/good.png {bad}/good.png",
    "one image to register": "register {bad}/good.png",
    "a folder to register": "register {bad}/empty {bad}/good.png",
    "a folder to view": "view {bad}/empty",
    "an archive": "detect {bad}/archive.zip",
    "a list of images": "stitch {bad}/matrix.txt {bad}/good.png -o {bad}/p.png",
    "a pattern": "detect {bad}/*.gif",
    "images to match": "match-many {bad}/good.png --pairs exhaustive",
    "two folders": "extract {bad} {bad}",
    "two videos": "track {bad}/video.mp4 {bad}/video.mp4",
    "an argument for no command": "doctor {bad}",
    "three images to view": "view {bad}/good.png {bad}/good.png {bad}/good.png {bad}/good.png",
    **{
        f"a video to {words}": words.replace("IMAGE", "{bad}/good.png").replace(
            "VIDEO", "{bad}/video.mp4"
        )
        for words in (
            *("detect VIDEO", "match VIDEO", "match IMAGE VIDEO", "register IMAGE VIDEO"),
            *("stitch VIDEO", "pose VIDEO IMAGE", "reconstruct VIDEO", "reconstruct IMAGE VIDEO"),
            *("reconstruct IMAGE IMAGE VIDEO", "extract VIDEO"),
            *("detect IMAGE --ignore VIDEO", "export colmap VIDEO", "view VIDEO"),
        )
    },
    "long name of a folder": "detect {bad}/good.png -o {bad}/{long}",
    "long name of a file": "export onnx dense -o {bad}/{long}.onnx",
    "long name of pictures": "register {bad}/good.png {bad}/good.png -o {bad}/{long}/out",
}


@pytest.mark.parametrize("arguments", CASES.values(), ids=CASES.keys())
def test_one_sentence_and_exit_code_2(run, bad: Path, arguments: str) -> None:
    if arguments.startswith("train") or "weights.safetensors" in arguments:
        pytest.importorskip("torch", reason="needs torch, which is for training only")
    before = {path: path.read_bytes() for path in bad.rglob("*") if path.is_file()}
    result = run(*arguments.format(bad=bad, long="x" * 300).split())
    assert result.exit_code == 2, result.output
    assert result.stderr.startswith("deepdetect: ")
    assert len(result.stderr.strip().splitlines()) == 1, result.stderr
    assert "video" in result.stderr or "video" not in arguments
    assert {path: path.read_bytes() for path in bad.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
def test_bad_weights_make_no_noise_of_native_code(
    photos: Path, tmp_path: Path, backend: str
) -> None:
    pytest.importorskip(backend, reason=f"needs {backend}")
    whole = pretrained_weights().read_bytes()
    path = tmp_path / "weights.onnx"
    path.write_bytes(whole[: len(whole) // 2])
    command = [sys.executable, "-m", "deepdetect", "detect", str(photos / "cat.jpg")]
    command += ["--weights", str(path), "--backend", backend]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2
    assert one_sentence(done.stderr)
    assert done.stdout == ""


def test_a_folder_without_permission_is_one_sentence(run, bad: Path) -> None:
    closed = bad / "empty"
    closed.chmod(0)
    if os.access(closed, os.X_OK):
        pytest.skip("needs folders that are closed to this user, as they are not to root")
    try:
        result = run("detect", bad / "good.png", "-o", closed / "out")
    finally:
        closed.chmod(0o700)
    assert result.exit_code == 2, result.output
    assert one_sentence(result.stderr)
    assert str(closed) in result.stderr
    assert not [*closed.iterdir()]
