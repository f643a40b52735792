from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepdetect import DeepDetect, DeepDetectError
from deepdetect.io.tables import load_keypoints


def test_writes_keypoints_and_pictures(run, photos: Path) -> None:
    result = run("detect", photos / "cat.jpg", "-o", "out")
    assert result.exit_code == 0, result.output
    assert {p.name for p in Path("out").iterdir()} == {
        "cat.npz",
        "cat_keypoints.png",
        "cat_heatmap.png",
    }
    keypoints = load_keypoints("out/cat.npz")
    expected = DeepDetect().detect(photos / "cat.jpg")
    np.testing.assert_array_equal(keypoints.xy, expected.xy)
    np.testing.assert_array_equal(keypoints.scores, expected.scores)
    assert f"{len(expected):,} keypoints" in result.stdout
    assert np.asarray(Image.open("out/cat_heatmap.png")).shape == (150, 200, 3)


def test_json_has_the_numbers_and_the_pictures(run, photos: Path) -> None:
    result = run("detect", photos / "cat.jpg", "--json", "--max-keypoints", 50, "--nms-radius", 2)
    report = json.loads(result.stdout)
    (image,) = report["images"]
    assert image["keypoints"] == 50
    assert (image["width"], image["height"]) == (200, 150)
    assert Path(image["pictures"]["heatmap"]).exists()
    assert report["failures"] == []


def test_csv_and_no_pictures(run, photos: Path) -> None:
    result = run(
        *("detect", photos / "cat.jpg", "-o", "out", "--format", "csv", "--no-pictures"),
        *("--density", 0.05),
    )
    assert result.exit_code == 0
    assert [p.name for p in Path("out").iterdir()] == ["cat.csv"]
    lines = Path("out/cat.csv").read_text().splitlines()
    assert lines[0] == "x,y,score"
    assert len(lines) == 1 + round(0.05 * 150 * 200)


def test_a_folder_is_searched(run, photos: Path) -> None:
    report = json.loads(run("detect", photos, "--no-pictures", "--json").stdout)
    assert {Path(image["image"]).name for image in report["images"]} == {
        "cat.jpg",
        "left.png",
        "right.png",
    }


def test_the_ignore_mask_is_kept_free(run, photos: Path) -> None:
    mask = np.zeros((150, 200), np.uint8)
    mask[:, 100:] = 255
    Image.fromarray(mask).save("ignore.png")
    assert run("detect", photos / "cat.jpg", "-o", "out", "--ignore", "ignore.png").exit_code == 0
    assert load_keypoints("out/cat.npz").xy[:, 0].max() < 100


def test_one_bad_image_does_not_stop_the_others(run, photos: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad.png"
    bad.write_bytes((photos / "left.png").read_bytes()[:2000])
    result = run("detect", bad, photos / "cat.jpg", "-o", "out", "--no-pictures")
    assert result.exit_code == 2
    assert "1 of 2 images failed" in result.stderr
    assert Path("out/cat.npz").exists()
    assert not Path("out/bad.npz").exists()


def test_two_images_of_one_name_are_refused(run, photos: Path, tmp_path: Path) -> None:
    other = tmp_path / "cat.png"
    Image.open(photos / "cat.jpg").save(other)
    result = run("detect", photos / "cat.jpg", other)
    assert result.exit_code == 2
    assert "same files" in result.stderr


def test_several_images_show_progress_on_stderr_only(run, photos: Path) -> None:
    result = run("detect", photos, "--no-pictures", "--json")
    assert "image/s" in result.stderr or "s/image" in result.stderr
    json.loads(result.stdout)


@pytest.mark.parametrize("size", ["auto", "1.5"])
def test_flips_and_tiles(run, photos: Path, size: str) -> None:
    options = ["--no-pictures", "--tta", "flip", "--tile-megapixels", size]
    run("detect", photos / "cat.jpg", "-o", "out", *options)
    expected = DeepDetect(tta="flip").detect(photos / "cat.jpg")
    np.testing.assert_array_equal(load_keypoints("out/cat.npz").xy, expected.xy)


@pytest.mark.parametrize("size", ["0.2", "many"])
def test_wrong_tiles(run, photos: Path, size: str) -> None:
    result = run("detect", photos / "cat.jpg", "--tile-megapixels", size)
    assert result.exit_code == 2
    assert "--tile-megapixels" in result.output


@pytest.mark.parametrize("short", [MemoryError, DeepDetectError("there is not enough memory")])
def test_an_image_without_memory_for_it_does_not_end_the_others(
    short: type[BaseException] | BaseException,
    run,
    photos: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    detect = DeepDetect.detect

    def detect_small(self: DeepDetect, image: np.ndarray, *args: object, **options: object):
        if image.shape[0] == 150:
            raise short
        return detect(self, image, *args, **options)

    monkeypatch.setattr(DeepDetect, "detect", detect_small)
    result = run("detect", photos, "-o", "out", "--no-pictures")
    assert result.exit_code == 2
    assert "1 of 3 images failed, the others are done" in result.output
    assert "not enough memory" in result.output
    assert {path.name for path in Path("out").iterdir()} == {"left.npz", "right.npz"}


@pytest.mark.parametrize("resolution", ["native", "240"])
def test_resolution(run, photos: Path, resolution: str) -> None:
    run("detect", photos / "cat.jpg", "-o", "out", "--resolution", resolution, "--no-pictures")
    chosen = resolution if resolution == "native" else int(resolution)
    expected = DeepDetect(resolution=chosen).detect(photos / "cat.jpg")
    np.testing.assert_array_equal(load_keypoints("out/cat.npz").xy, expected.xy)
