from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from deepdetect import DeepDetect, DeepDetectError, Keypoints, load_image
from deepdetect.detector.detector import find_keypoints
from deepdetect.interchange.sources import read_collection
from deepdetect.io.tables import load_keypoints
from deepdetect.viz.draw import CAPTION_HEIGHT


def test_writes_keypoints_and_pictures(run, photos: Path) -> None:
    result = run("detect", photos / "cat.jpg", "-o", "out")
    assert result.exit_code == 0, result.output
    assert {p.name for p in Path("out").iterdir()} == {
        ".deepdetect",
        "cat.npz",
        "cat_keypoints.jpg",
        "cat_dense.jpg",
        "cat_heatmap.jpg",
    }
    keypoints = load_keypoints("out/cat.npz")
    expected = DeepDetect().detect(photos / "cat.jpg")
    np.testing.assert_array_equal(keypoints.xy, expected.xy)
    np.testing.assert_array_equal(keypoints.scores, expected.scores)
    assert f"{len(expected):,} keypoints" in result.stdout
    for name in ("keypoints", "dense", "heatmap"):
        picture = np.asarray(Image.open(f"out/cat_{name}.jpg"))
        assert picture.shape == (150 + CAPTION_HEIGHT, 200, 3)


def test_one_bad_image_does_not_stop_the_others(run, photos: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad.png"
    bad.write_bytes((photos / "left.png").read_bytes()[:2000])
    result = run("detect", bad, photos / "cat.jpg", "-o", "out", "--no-pictures")
    assert result.exit_code == 1
    assert str(bad) in result.stderr.splitlines()[-1]
    assert Path("out/cat.npz").exists()
    assert not Path("out/bad.npz").exists()


@pytest.mark.parametrize("more", [[], ["--max-keypoints", 9]])
def test_images_without_a_keypoint_have_an_exit_code_of_their_own(
    run, photos: Path, more: list[object]
) -> None:
    Path("in").mkdir()
    Image.new("RGB", (64, 48), (90, 90, 90)).save("in/flat.png")
    words = ["detect", "in", "-o", "out", "--no-pictures", *more]
    for _ in range(2):  # also where all is done already
        result = run(*words)
        assert result.exit_code == 3
        assert "0 keypoints" in result.stdout
    assert len(load_keypoints("out/flat.npz")) == 0
    shutil.copy(photos / "cat.jpg", "in")
    assert run(*words).exit_code == 0


def test_images_of_one_name_keep_their_folders_or_their_endings(run, photos: Path) -> None:
    for name in ("set/left/0.jpg", "set/right/0.jpg", "set/right/1.jpg", "set/right/1.png"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Image.open(photos / "cat.jpg").save(name)
    for sources in (["set"], ["set/left", "set/right"]):
        result = run("detect", *sources, "-o", "out", "--max-keypoints", 9, "--json")
        assert result.exit_code == 0, result.output
        files = {image["image"]: image["file"] for image in json.loads(result.stdout)["images"]}
        assert files == {
            "set/left/0.jpg": "out/left/0.npz",
            "set/right/0.jpg": "out/right/0.npz",
            "set/right/1.jpg": "out/right/1.jpg.npz",
            "set/right/1.png": "out/right/1.png.npz",
        }
        assert len(load_keypoints("out/right/1.png.npz")) == 9
    # What this has drawn is no photograph to the next command.
    again = run("detect", ".", "-o", "again", "--max-keypoints", 9, "--json")
    assert {image["image"] for image in json.loads(again.stdout)["images"]} == {*files}
    saved = read_collection([*Path("out").rglob("*.npz")], images=Path("set"))
    assert {*saved.keypoints} == {name.removeprefix("set/") for name in files}


@pytest.mark.parametrize("short", [MemoryError, DeepDetectError("there is not enough memory")])
def test_an_image_without_memory_for_it_does_not_end_the_others(
    short: type[BaseException] | BaseException,
    run,
    photos: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def find_small(detector: DeepDetect, rgb: np.ndarray, *options: object) -> Keypoints:
        if rgb.shape[0] == 150:
            raise short
        return find_keypoints(detector, rgb, *options)

    monkeypatch.setattr("deepdetect.cli.detect.find_keypoints", find_small)
    result = run("detect", photos, "-o", "out", "--no-pictures")
    assert result.exit_code == 1
    assert "cat.jpg" in result.stderr
    assert {path.name for path in Path("out").glob("*.npz")} == {"left.npz", "right.npz"}


def detect(run, images: Path, *more: object) -> list[dict[str, Any]]:
    """Detect without pictures into "out" and return the report on each image."""
    result = run("detect", images, "-o", "out", "--no-pictures", "--json", *more)
    assert result.exit_code == 0, result.output
    images_done: list[dict[str, Any]] = json.loads(result.stdout)["images"]
    return images_done


def copies(photos: Path, folder: Path, count: int = 2) -> Path:
    folder.mkdir()
    for k in range(count):
        shutil.copy(photos / "cat.jpg", folder / f"{k}.jpg")
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def test_what_is_done_is_skipped(run, photos: Path) -> None:
    first = detect(run, photos)
    assert not any(image["skipped"] for image in first)
    Path("out/left.npz").unlink()
    kept = Path("out/cat.npz").stat().st_mtime_ns
    again = detect(run, photos)
    assert {Path(i["image"]).stem: i["skipped"] for i in again} == {
        "cat": True,
        "left": False,
        "right": True,
    }
    for before, after in zip(first, again, strict=True):
        same = {"image", "width", "height", "keypoints", "density", "file", "pictures"}
        assert {n: before[n] for n in same} == {n: after[n] for n in same}
    assert Path("out/cat.npz").stat().st_mtime_ns == kept
    result = run("detect", photos, "-o", "out", "--no-pictures")
    assert result.stdout.count("already done") == 3
    assert not any(image["skipped"] for image in detect(run, photos, "--overwrite"))


def test_an_image_that_has_changed_is_done_again(run, photos: Path) -> None:
    folder = copies(photos, Path("in"))
    detect(run, folder)
    shutil.copy(photos / "left.png", folder / "1.jpg")
    assert [image["skipped"] for image in detect(run, folder)] == [True, False]
    np.testing.assert_array_equal(
        load_keypoints("out/1.npz").xy, DeepDetect().detect(photos / "left.png").xy
    )


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--weights", "dense"], "--weights"),
        (["--threshold", 0.6, "--ignore", "ignore.png"], "--ignore, --threshold"),
    ],
)
def test_what_was_made_with_other_settings_is_replaced_and_named(
    run, photos: Path, more: list[object], told: str
) -> None:
    mask = np.zeros((150, 200), np.uint8)
    mask[:75] = 255
    Image.fromarray(mask).save("ignore.png")
    detect(run, photos / "cat.jpg")
    before = contents(Path("out"))
    result = run("detect", photos / "cat.jpg", "-o", "out", "--no-pictures", *more)
    assert result.exit_code == 0, result.output
    assert told in result.stderr
    assert contents(Path("out")) != before
    assert len(contents(Path("out"))) == 1
    assert detect(run, photos / "cat.jpg", *more)[0]["skipped"]


def test_the_first_thing_that_one_tries_works(run, photos: Path) -> None:
    assert run("detect", photos / "cat.jpg").exit_code == 0
    result = run("detect", photos / "cat.jpg", "--max-keypoints", 50)
    assert result.exit_code == 0, result.output
    assert len(load_keypoints("deepdetect-output/cat.npz")) == 50
    assert "cat_dense.jpg" in contents(Path("deepdetect-output"))
    words = ("detect", photos / "cat.jpg", "--detector", "points", "--max-keypoints", 50)
    assert run(*words).exit_code == 0
    assert {*contents(Path("deepdetect-output"))} == {"cat.npz", "cat_keypoints.jpg"}


def test_outputs_that_were_edited_are_never_replaced_silently(run, photos: Path) -> None:
    detect(run, copies(photos, Path("in")))
    shutil.copy("out/1.npz", "out/0.npz")
    with Path("out/0.npz").open("ab") as file:
        file.write(b"more")
    before = contents(Path("out"))
    result = run("detect", "in", "-o", "out", "--no-pictures")
    assert result.exit_code == 2
    assert "0.npz" in result.stderr
    assert contents(Path("out")) == before


def test_pictures_of_an_earlier_run_are_no_inputs(run, photos: Path) -> None:
    folder = copies(photos, Path("in"))
    Path("link").symlink_to("in")
    for skipped in (False, True):
        result = run("detect", folder, "-o", "link", "--json")
        assert result.exit_code == 0, result.output
        images = json.loads(result.stdout)["images"]
        assert [Path(image["image"]).name for image in images] == ["0.jpg", "1.jpg"]
        assert [image["skipped"] for image in images] == [skipped] * 2
    for name in ("0.jpg", "1.jpg"):
        (folder / name).unlink()
    assert run("detect", folder, "-o", "link").exit_code == 2


def test_pictures_that_a_pattern_names_beside_their_image_are_left_out(run, photos: Path) -> None:
    shutil.copy(photos / "cat.jpg", "cat.jpg")
    assert run("detect", "cat.jpg", "-o", ".").exit_code == 0
    again = run("detect", *sorted(Path().glob("*.jpg")), "-o", ".", "--json")
    assert [image["image"] for image in json.loads(again.stdout)["images"]] == ["cat.jpg"]
    assert "cat_dense.jpg" in again.stderr


@pytest.mark.parametrize("name", ["-", "/dev/stdin"])
def test_images_come_from_standard_input(name: str, photos: Path, tmp_path: Path) -> None:
    words = [sys.executable, "-m", "deepdetect", "match", name, str(photos / "cat.jpg"), "--json"]
    words += ["-o", str(tmp_path)]
    content = (photos / "cat.jpg").read_bytes()
    done = subprocess.run(words, input=content, capture_output=True)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    np.testing.assert_allclose(found["geometry"]["matrix"], np.eye(3), atol=1e-6)
    assert Path(found["file"]).name == "stdin_cat_matches.npz"


@pytest.mark.skipif(not os.path.isdir("/dev/fd"), reason="needs /dev/fd")
def test_images_come_from_pipes_of_a_shell(photos: Path) -> None:
    content = (photos / "cat.jpg").read_bytes()
    read, write = os.pipe()
    with ThreadPoolExecutor(1) as pool, os.fdopen(write, "wb") as file:
        done = pool.submit(load_image, f"/dev/fd/{read}")
        file.write(content)
        file.close()
        np.testing.assert_array_equal(done.result(60), load_image(content))
    os.close(read)


def test_an_input_is_never_written_over(run, photos: Path) -> None:
    shutil.copy(photos / "left.png", "a.png")
    shutil.copy(photos / "cat.jpg", "a_heatmap.jpg")
    before = contents(Path())
    assert run("detect", "a.png", "a_heatmap.jpg", "-o", ".", "--overwrite").exit_code == 2
    assert contents(Path()) == before


def start(folder: Path, output: Path) -> subprocess.Popen[bytes]:
    arguments = ["detect", str(folder), "-o", str(output), "--no-pictures"]
    return subprocess.Popen(
        [sys.executable, "-m", "deepdetect", *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def test_a_killed_run_goes_on_where_it_stopped(run, photos: Path) -> None:
    folder = copies(photos, Path("in"), 20)
    process = start(folder, Path("out"))
    deadline = time.monotonic() + 120
    while not list(Path().glob("out/*.npz")):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.kill()
    process.wait()
    done = len(contents(Path("out")))
    assert done < 20, "it was killed too late for this test"
    skipped = sum(image["skipped"] for image in detect(run, folder))
    assert 0 < skipped + 1 <= done + 1 <= 20
    assert sorted(contents(Path("out"))) == sorted(f"{k}.npz" for k in range(20))
    assert len({*contents(Path("out")).values()}) == 1


def test_photographs_over_a_limit_are_refused_and_it_can_be_raised(run, photos: Path) -> None:
    photo, megapixels = photos / "left.png", 200 * 160 / 1e6
    words = ("detect", photo, "-o", "limited", "--no-pictures", "--max-megapixels")
    refused = run(*words, megapixels * 0.99)
    assert refused.exit_code == 2, refused.output
    assert "--max-megapixels" in refused.stderr
    assert run(*words, megapixels * 1.01).exit_code == 0
    assert run(*words, 0).exit_code == 2
