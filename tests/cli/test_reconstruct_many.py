"""`deepdetect reconstruct` with folders; what its results are worth is tested in tests/sfm."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from .conftest import one_sentence


@pytest.fixture
def fountain(shared: Path, tmp_path: Path) -> Path:
    """Small photographs of the fountain, and a black one."""
    pytest.importorskip("h5py", reason="needs h5py")
    pytest.importorskip("pycolmap", reason="needs pycolmap")
    folder = tmp_path / "photos"
    folder.mkdir()
    for name in ("0004", "0005", "0006"):
        with Image.open(shared / "data" / "fountain" / f"{name}.jpg") as image:
            image.resize((288, 192), Image.Resampling.LANCZOS).save(folder / f"{name}.jpg")
    Image.new("RGB", (288, 192)).save(folder / "black.png")
    return folder


def test_a_folder_becomes_a_model(run, fountain: Path) -> None:
    arguments = ("reconstruct", fountain, "-o", "model", "--workers", 1, "--focal", 259)
    result = run(*arguments, "--max-keypoints", 1200, "--json")
    assert result.exit_code == 0, result.output
    values = json.loads(result.stdout)
    assert values == json.loads(Path("model/model.json").read_text())
    assert (values["images"], values["registered"]) == (4, 3)
    assert list(values["unregistered"]) == ["black.png"]
    assert values["dense_points"] > 1000
    assert values["cameras"]["0005.jpg"]["intrinsics"] == "focal_px"
    stages = {"features", "matching", "mapping", "dense points"}
    assert set(values["seconds"]) == stages
    for file in values["files"]:
        assert Path(file).exists()
    assert "mapping" in result.stderr

    again = run(*arguments, "--max-keypoints", 1200)
    assert again.exit_code == 0, again.output
    assert "unregistered: black.png" in again.stdout
    assert run(*arguments, "--max-keypoints", 1000).exit_code == 2

    # Other photographs do not take the place of these, not even of what a killed run has left.
    for gone in ("model.ply", "model.glb", "model.html", "model.json", "database.db"):
        Path("model", gone).unlink()
    copy = shutil.copytree(fountain, fountain.with_name("others"))
    assert run("reconstruct", copy, *arguments[2:], "--max-keypoints", 1200).exit_code == 2
    assert not Path("model/model.ply").exists()


def test_a_list_of_photographs_and_results_within_the_folder(
    run, fountain: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(fountain)
    images = ("0004.jpg", "0005.jpg", "0006.jpg")
    few = ("--workers", 1, "--max-keypoints", 1000, "--no-dense", "--json")
    more = (*few, "--pairs", "sequential:2", "-o", "model")
    result = run("reconstruct", *images, *more)
    assert result.exit_code == 0, result.output
    values = json.loads(result.stdout)
    assert (values["registered"], values["pairs"], values["dense_points"]) == (3, 3, 0)
    # More photographs are added to them; fewer would be another model.
    added = run("reconstruct", *images, "black.png", *more)
    assert added.exit_code == 0, added.output
    assert json.loads(added.stdout)["images"] == 4
    assert run("reconstruct", *images, *more).exit_code == 2
    # Neither the links to listed photographs, nor pictures of other commands, are photographs.
    whole = run("reconstruct", ".", *few)
    assert whole.exit_code == 0, whole.output
    values = json.loads(whole.stdout)
    assert (values["images"], values["registered"]) == (4, 3)
    drawn = run("detect", "black.png", "-o", "drawn")
    assert drawn.exit_code == 3, drawn.output
    for _ in range(2):  # nor are those of a format
        again = run("reconstruct", ".", *few, "--format", "splat", "--format", "text")
        assert again.exit_code == 0, again.output
        assert json.loads(again.stdout)["images"] == 4
    again = run("reconstruct", ".", *few)
    assert json.loads(again.stdout)["images"] == 4
    # A known distance, and what lacks a place, which is said when all else is written.
    scaled = run("reconstruct", ".", *few, "--scale-by", 2.5, "0004.jpg", "0006.jpg")
    values = json.loads(scaled.stdout)
    centres = [np.array(values["cameras"][name]["centre"]) for name in ("0004.jpg", "0006.jpg")]
    assert np.linalg.norm(centres[1] - centres[0]) == pytest.approx(2.5)
    assert run("reconstruct", ".", *few, "--format", "map").exit_code == 2
    # Points that are not where they are marked.
    pytest.importorskip("pyproj", reason="needs pyproj")
    places = np.random.default_rng(0).uniform(0, 100, (6, 3)) + [500_000, 5_000_000, 0]
    marks = [
        f"{x} {y} {z} {50 * k + 40} {30 * k + 30} {name} mark {k}"
        for k, (x, y, z) in enumerate(places)
        for name in ("0004.jpg", "0006.jpg")
    ]
    (fountain / "gcp_list.txt").write_text("\n".join(["EPSG:32632", *marks]))
    assert run("reconstruct", ".", *few, "--gcp", "gcp_list.txt").exit_code == 3


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("a.png", ""),
        (". a.png", ""),
        ("a.png b.png --no-dense", "--dense"),
        ("a.png b.png --pairs sequential:3", "--pairs"),
        (". --rectified", "--rectified"),
    ],
)
def test_options_of_the_other_kind_are_refused(run, words: str, named: str) -> None:
    for name in ("a.png", "b.png"):
        Image.fromarray(np.zeros((32, 32, 3), np.uint8)).save(name)
    result = run("reconstruct", *words.split())
    assert result.exit_code == 2
    assert one_sentence(result.stderr)
    assert named in result.stderr


def test_without_pycolmap_it_says_what_to_install(run, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    result = run("reconstruct", tmp_path, "-o", "model")
    assert result.exit_code == 2
    assert "pip install pycolmap" in result.stderr
    assert not Path("model").exists()
