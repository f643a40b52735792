from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image

from deepdetect import load_image
from deepdetect.io.image import luma
from deepdetect_lab.labels import fuse


def test_writes_one_bit_masks(run, photos: Path) -> None:
    result = run("label", photos, "-o", "masks", "--workers", 1)
    assert result.exit_code == 0, result.output
    assert {p.name for p in Path("masks").glob("*.png")} == {"cat.png", "left.png", "right.png"}
    with Image.open("masks/cat.png") as mask:
        assert mask.mode == "1"
        expected = fuse(luma(load_image(photos / "cat.jpg"))).mask
        np.testing.assert_array_equal(np.asarray(mask), expected)
    assert "3 labelled, 0 already done" in result.stdout


def test_several_processes_give_the_same_and_what_is_done_is_skipped(run, photos: Path) -> None:
    words = ("label", photos, "--detectors", "fast,sobel", "--json", "-o")
    for output, workers in (("one", 1), ("two", 2)):
        assert len(json.loads(run(*words, output, "--workers", workers).stdout)["labelled"]) == 3
    for path in Path("one").glob("*.png"):
        assert path.read_bytes() == (Path("two") / path.name).read_bytes()
    Path("one/cat.png").unlink()
    kept = Path("one/left.png").stat().st_mtime_ns
    report = json.loads(run(*words, "one", "--workers", 1).stdout)
    assert [Path(entry["image"]).name for entry in report["labelled"]] == ["cat.jpg"]
    assert report["skipped"] == 2
    assert Path("one/left.png").stat().st_mtime_ns == kept


def test_masks_of_other_settings_are_not_passed_off(run, photos: Path) -> None:
    run("label", photos / "cat.jpg", "-o", "masks", "--workers", 1)
    before = Path("masks/cat.png").read_bytes()
    result = run("label", photos / "cat.jpg", "-o", "masks", "--detectors", "fast")
    assert result.exit_code == 2
    assert Path("masks/cat.png").read_bytes() == before
    result = run("label", photos / "cat.jpg", "-o", "masks", "--detectors", "fast", "--overwrite")
    assert result.exit_code == 0
    assert Path("masks/cat.png").read_bytes() != before


def test_visualize_draws_four_panels(run, photos: Path) -> None:
    run("label", photos / "cat.jpg", "-o", "masks", "--visualize", "--workers", 1)
    panels = np.asarray(Image.open("masks/cat_labels.png"))
    label = fuse(luma(load_image(photos / "cat.jpg")))
    assert panels.shape[1] == 4 * 200 + 3 * 6
    # The panels in order: image, keypoint mask, edge mask, combined.
    np.testing.assert_array_equal(panels[:150, :200], load_image(photos / "cat.jpg"))
    for k, mask in ((1, label.keypoints), (2, label.edges), (3, label.mask)):
        left = k * 206
        np.testing.assert_array_equal(panels[:150, left : left + 200, 0] > 0, mask)


def test_a_bad_image_is_reported_and_the_others_are_done(run, photos: Path) -> None:
    Path("in").mkdir()
    Path("in/bad.jpg").write_bytes(b"not a photograph")
    Path("in/good.png").write_bytes((photos / "left.png").read_bytes())
    result = run("label", "in", "-o", "masks", "--workers", 1)
    assert result.exit_code == 1
    assert "bad.jpg" in result.stderr.splitlines()[-1]
    assert [p.name for p in Path("masks").glob("*.png")] == ["good.png"]


def test_a_photograph_is_never_replaced_by_its_mask(run, photos: Path, tmp_path: Path) -> None:
    photograph = tmp_path / "photo.png"
    photograph.write_bytes((photos / "left.png").read_bytes())
    for more in ([], ["--overwrite"]):
        assert run("label", "photo.png", "-o", ".", *more).exit_code == 2
    assert photograph.read_bytes() == (photos / "left.png").read_bytes()
