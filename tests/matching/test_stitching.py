from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from deepdetect import DeepDetectError, OptionError
from deepdetect.cli import main
from deepdetect.matching.stitching import stitch


@pytest.fixture(scope="module")
def whole() -> np.ndarray:
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    return data.coffee()


@pytest.fixture(scope="module")
def views(whole: np.ndarray) -> list[np.ndarray]:
    """Three overlapping parts of one photograph, (400, 300, 3) each."""
    return [np.ascontiguousarray(whole[:, left : left + 300]) for left in (0, 150, 300)]


def test_the_parts_become_the_whole(views: list[np.ndarray], whole: np.ndarray) -> None:
    panorama = stitch([views[2], views[0], views[1]])
    assert panorama.used == (0, 1, 2)
    assert panorama.picture.dtype == np.uint8
    height, width = panorama.picture.shape[:2]
    assert abs(height - 400) < 20
    assert abs(width - 600) < 20
    found = cv2.resize(panorama.picture, (600, 400), interpolation=cv2.INTER_AREA)
    inside = (slice(20, -20), slice(20, -20))
    assert np.abs(found.astype(int) - whole)[inside].mean() < 25  # left is left, red is red


def test_what_cannot_be_connected_is_told(views: list[np.ndarray], tmp_path: Path) -> None:
    data = pytest.importorskip("skimage.data")
    strange = np.ascontiguousarray(data.rocket()[:300, :300])
    assert stitch([views[0], strange, views[1]]).used == (0, 2)
    for name, view in zip("abc", (views[0], strange, views[1]), strict=True):
        Image.fromarray(view).save(tmp_path / f"{name}.png")
    files = [str(tmp_path / f"{name}.png") for name in "abc"]
    result = CliRunner().invoke(main, ["stitch", *files, "-o", str(tmp_path / "p.png"), "--json"])
    report = json.loads(result.stdout)
    assert report["left_out"] == [files[1]]
    assert report["images"] == [files[0], files[2]]


def test_what_makes_no_panorama_is_refused(views: list[np.ndarray]) -> None:
    with pytest.raises(OptionError, match="two photographs"):
        stitch(views[:1])
    noise = np.random.default_rng(0).integers(0, 256, (200, 200, 3)).astype(np.uint8)
    with pytest.raises(DeepDetectError, match="these 2 photographs make no panorama"):
        stitch([views[0], noise])


def test_the_command_writes_the_file(views: list[np.ndarray], tmp_path: Path) -> None:
    for name, view in zip("abc", views, strict=True):
        Image.fromarray(view).save(tmp_path / f"{name}.png")
    files = [str(tmp_path / f"{name}.png") for name in "cab"]
    output = tmp_path / "panorama.jpg"
    result = CliRunner().invoke(main, ["stitch", *files, "-o", str(output)])
    assert result.exit_code == 0, result.output
    with Image.open(output) as picture:
        width, height = picture.size
        assert picture.format == "JPEG"
    assert f"{width}x{height}" in result.output
    alone = CliRunner().invoke(main, ["stitch", files[0], "-o", str(tmp_path / "no.jpg")])
    assert alone.exit_code == 2
    assert not (tmp_path / "no.jpg").exists()


@pytest.fixture
def files(views: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Two overlapping photographs in the folder that is worked in."""
    monkeypatch.chdir(tmp_path)
    for name, view in zip("ab", views[:2], strict=True):
        Image.fromarray(view).save(f"{name}.png")
    return [Path("a.png"), Path("b.png")]


def refused(*arguments: object) -> str:
    result = CliRunner().invoke(main, ["stitch", *map(str, arguments)])
    assert result.exit_code == 2, result.output
    assert len(result.stderr.strip().splitlines()) == 1, result.stderr
    return result.stderr


def test_photographs_are_not_written_over(files: list[Path]) -> None:
    Path("link.png").symlink_to("b.png")
    before = {path: path.read_bytes() for path in files}
    for output in ("a.png", Path("a.png").resolve(), "link.png"):
        assert "would be written over, which is an input: give the panorama" in refused(
            *files, "-o", output
        )
    Path("panorama.jpg").write_bytes(files[0].read_bytes())  # of the time before
    assert "panorama.jpg would be written over" in refused(*files, "panorama.jpg")
    assert Path("panorama.jpg").read_bytes() == before[files[0]]
    assert {path: path.read_bytes() for path in files} == before
    # A panorama that is no input is made anew.
    assert CliRunner().invoke(main, ["stitch", *map(str, files)]).exit_code == 0
    assert Path("panorama.jpg").read_bytes() != before[files[0]]


@pytest.mark.parametrize("output", ["panorama", "panorama.tif"])
def test_an_unknown_ending_ends_before_the_work(
    files: list[Path], output: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "deepdetect.matching.stitching.stitch", lambda images: pytest.fail("it worked")
    )
    assert "must end in .png, .jpg or .jpeg" in refused(*files, "-o", output)


def test_an_error_of_opencv_is_one_sentence(
    views: list[np.ndarray], monkeypatch: pytest.MonkeyPatch, one_line: Any
) -> None:
    class Failing:
        def stitch(self, images: list[np.ndarray]) -> None:
            cv2.resize(np.empty((0, 0), np.uint8), (3, 3))  # an error of OpenCV itself

    monkeypatch.setattr(cv2.Stitcher, "create", lambda mode: Failing())
    with pytest.raises(
        DeepDetectError, match="make no panorama: OpenCV's stitcher failed"
    ) as error:
        stitch(views)
    one_line(error.value)
