"""Each task of the page: its progress, its files, and what it says."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import deepdetect
from deepdetect import load_image, load_matches, register
from deepdetect._shared.errors import DeepDetectError
from deepdetect.app import tasks
from deepdetect.app.tasks import TASKS, SentImage, TaskResult
from deepdetect.reconstruction.result import ENDINGS

EXAMPLES = Path(deepdetect.__path__[0]) / "app/static/examples"


@pytest.fixture(scope="module")
def examples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The examples of the page at half their size."""
    folder = tmp_path_factory.mktemp("examples")
    for path in EXAMPLES.glob("*.jpg"):
        with Image.open(path) as image:
            image.reduce(2).save(folder / path.name, quality=95)
    return folder


def run(
    kind: str, examples: Path, names: Sequence[str], folder: Path, **options: float
) -> tuple[TaskResult, list[tuple[str, int, int]]]:
    """Run a task on examples of the page; return its result and its progress."""
    told: list[tuple[str, int, int]] = []
    images = [SentImage(examples / name, name) for name in names]
    result = TASKS[kind].run(images, options, folder, lambda *stage: told.append(stage))
    for name in {result.shown, *result.files}:
        assert (folder / name).stat().st_size > 0
    assert all(isinstance(text, str) for text in result.numbers.values())
    done = [count for _, count, _ in told]
    assert done == sorted(done)
    assert all(0 <= count < total for _, count, total in told if total)
    assert len(told) > 1
    return result, told


def test_matching(examples: Path, tmp_path: Path) -> None:
    pytest.importorskip("numba")
    result, told = run("match", examples, ["coffee.jpg", "coffee-turned.jpg"], tmp_path)
    stages = ["keypoints", "guided matching", "geometry", "files"]
    assert [stage for stage, _, _ in told] == stages
    matches = load_matches(tmp_path / "matches.npz")
    assert result.numbers["Matches"] == f"{len(matches):,}"
    assert len(matches) > 2_000


def test_registration(examples: Path, tmp_path: Path) -> None:
    pytest.importorskip("numba")
    names = ["coffee.jpg", "coffee-turned.jpg"]
    run("register", examples, names, tmp_path)
    expected = register(*(examples / name for name in names))
    np.testing.assert_allclose(np.loadtxt(tmp_path / "homography.txt"), expected.homography)
    np.testing.assert_array_equal(load_image(tmp_path / "registered.png"), expected.warped)


def test_a_panorama_names_what_is_left_out(examples: Path, tmp_path: Path) -> None:
    pytest.importorskip("numba")
    names = ["coffee.jpg", "motorcycle-left.jpg", "coffee-turned.jpg"]
    result, _ = run("stitch", examples, names, tmp_path)
    assert result.numbers["Images"] == "2 of 3"
    assert result.numbers["Left out"] == "motorcycle-left.jpg"
    assert load_image(tmp_path / "panorama.jpg").shape[1] >= 300


def test_a_model_and_a_focal_length_that_is_not_known_is_assumed_and_said(
    examples: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("numba")
    names = ["motorcycle-left.jpg", "motorcycle-right.jpg"]
    result, _ = run("reconstruct", examples, names, tmp_path)
    assert result.shown == "model.html"
    assert {*result.files} == {f"model{ending}" for ending in ENDINGS}
    assert result.numbers["Pair"] == "rectified"
    assert int(result.numbers["Points"].replace(",", "")) > 10_000
    width = load_image(examples / names[0]).shape[1]
    assert f"{1.2 * width:.0f} px" in result.numbers["Focal length"]

    def said(*_: object, focal_px: float, **__: object) -> None:
        raise DeepDetectError(f"{focal_px} px were given")

    monkeypatch.setattr(tasks, "reconstruct", said)
    with pytest.raises(DeepDetectError, match="995 px"):
        run("reconstruct", examples, names, tmp_path, focal_px=995)


def test_pictures_without_a_common_geometry(examples: Path, tmp_path: Path) -> None:
    pytest.importorskip("numba")
    with pytest.raises(DeepDetectError):
        run("match", examples, ["coffee.jpg", "motorcycle-left.jpg"], tmp_path)


@pytest.mark.slow
def test_a_model_of_a_folder(serve: Any, shared: Path) -> None:
    """By the server, as this task starts processes of its own."""
    pytest.importorskip("pycolmap")
    pytest.importorskip("h5py")
    client, _ = serve()
    files = []
    for number in range(3, 7):
        with Image.open(shared / f"data/fountain/{number:04d}.jpg") as image:
            small, file = image.resize((576, 384)), io.BytesIO()
        small.save(file, "jpeg", quality=92)
        files.append((f"fountain/{number:04d}.jpg", file.getvalue()))
    state = client.wait(client.start("folder-model", files).values["job"], 600)
    assert state["state"] == "done", state
    assert state["numbers"]["Images"] == "4 of 4"
    assert state["shown"] == "model.html"
