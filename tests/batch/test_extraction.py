from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from deepdetect import DeepDetect, OptionError, PointDetector, SelectionOptions, load_image
from deepdetect.batch import extract_features
from deepdetect.detector.pretrained import pretrained_weights
from deepdetect.features.sift import root_sift_descriptors
from deepdetect.io.image import luma
from deepdetect.io.picture_file import save_picture

FEW, PIXELS = PointDetector(50), SelectionOptions(max_keypoints=50)


@pytest.fixture(autouse=True)
def _h5py() -> None:
    pytest.importorskip("h5py", reason="needs h5py")


def test_the_layout_is_that_of_hloc(collection: Callable[..., Path], tmp_path: Path) -> None:
    """As hloc's `extract_features`, `get_keypoints` and `list_h5_names` write and read them."""
    import h5py

    folder = collection(3)
    report = extract_features(folder, tmp_path / "f.h5", FEW, workers=1)
    assert tuple(report.counts) == ("a/00.png", "a/02.png", "b/01.png")
    assert (report.skipped, sum(report.counts.values()), report.failures) == (0, 150, ())
    names = []

    def visit(_: str, member: object) -> None:
        if isinstance(member, h5py.Dataset):
            names.append(member.parent.name.strip("/"))

    with h5py.File(tmp_path / "f.h5", "r", libver="latest") as file:
        file.visititems(visit)
        assert set(names) == set(report.counts)
        stored = file["b/01.png"]
        found = {name: value[()] for name, value in stored.items()}
        assert stored["keypoints"].attrs["uncertainty"] == 1
    expected = FEW.detect(folder / "b/01.png")
    described = FEW.extract(folder / "b/01.png")
    assert {name: (value.shape, value.dtype.name) for name, value in found.items()} == {
        "keypoints": ((50, 2), "float32"),
        "descriptors": ((64, 50), "float32"),
        "scores": ((50,), "float32"),
        "scales": ((50,), "float32"),
        "oris": ((50,), "float32"),
        "colors": ((50, 3), "uint8"),
        "image_size": ((2,), "int32"),
    }
    np.testing.assert_array_equal(found["keypoints"], expected.xy)
    np.testing.assert_array_equal(found["scores"], expected.scores)
    np.testing.assert_array_equal(found["scales"], expected.sizes / 2)
    np.testing.assert_array_equal(found["oris"], expected.angles)
    np.testing.assert_array_equal(found["image_size"], [128, 128])
    x, y = np.rint(expected.xy[7]).astype(int)
    np.testing.assert_array_equal(found["colors"][7], load_image(folder / "b/01.png")[y, x])
    np.testing.assert_allclose(np.linalg.norm(found["descriptors"], axis=0), 1, rtol=1e-6)
    cosines = np.sum(found["descriptors"].T * described.descriptors, 1)
    lengths = np.linalg.norm(described.descriptors.astype(float), axis=1)
    np.testing.assert_allclose(cosines, lengths, rtol=1e-6)


def test_dense_keypoints(collection: Callable[..., Path], tmp_path: Path) -> None:
    import h5py

    folder = collection(1)
    extract_features(folder, tmp_path / "f.h5", DeepDetect(threads=1), workers=1)
    expected = DeepDetect(threads=1).detect(folder / "a/00.png")
    gray = luma(load_image(folder / "a/00.png"))
    descriptors = root_sift_descriptors(gray, expected.xy).astype(np.float32)
    with h5py.File(tmp_path / "f.h5") as file:
        np.testing.assert_array_equal(file["a/00.png/keypoints"], expected.xy)
        assert "oris" not in file["a/00.png"]
        lengths = np.linalg.norm(descriptors, axis=1, keepdims=True)
        np.testing.assert_allclose(
            file["a/00.png/descriptors"][()].T, descriptors / np.maximum(lengths, 1), atol=1e-6
        )


def test_the_number_of_keypoints_is_the_detectors_unless_the_selection_has_one(
    collection: Callable[..., Path], tmp_path: Path
) -> None:
    folder, path = collection(1), tmp_path / "f.h5"
    few, whole = DeepDetect(threads=1, max_keypoints=20), SelectionOptions(threshold=0.1)
    extract_features(folder, path, few, workers=1, selection=whole)
    again = extract_features(
        folder, path, few, workers=1, selection=replace(whole, max_keypoints=20)
    )
    assert again.skipped == 1
    with pytest.raises(OptionError, match=r"other settings \(`max_keypoints`\)"):
        extract_features(folder, path, DeepDetect(threads=1), workers=1, selection=whole)
    more = replace(whole, max_keypoints=30)
    found = extract_features(folder, path, few, workers=1, selection=more, overwrite=True)
    assert found.counts == {"a/00.png": 30}


def test_an_image_without_keypoints(tmp_path: Path) -> None:
    import h5py

    (tmp_path / "photos").mkdir()
    Image.new("RGB", (64, 48)).save(tmp_path / "photos/black.png")
    report = extract_features(tmp_path / "photos", tmp_path / "f.h5", workers=1)
    assert (tuple(report.counts), sum(report.counts.values())) == (("black.png",), 0)
    with h5py.File(tmp_path / "f.h5") as file:
        assert file["black.png/descriptors"].shape == (64, 0)
        assert file["black.png/keypoints"].shape == (0, 2)


def test_what_is_done_is_skipped_and_what_has_changed_is_not(
    collection: Callable[..., Path], tmp_path: Path, same_content: Callable[..., bool]
) -> None:
    path = tmp_path / "f.h5"
    folder = collection(2)
    extract_features(folder, path, FEW, workers=1)
    before = path.stat().st_mtime_ns
    report = extract_features(folder, path, FEW, workers=1)
    assert (tuple(report.counts), report.skipped) == ((), 2)
    assert path.stat().st_mtime_ns == before
    (folder / "c.png").write_bytes((folder / "a/00.png").read_bytes())
    (folder / "a/00.png").write_bytes((folder / "b/01.png").read_bytes())
    report = extract_features(folder, path, FEW, workers=1)
    assert (tuple(report.counts), report.skipped) == (("a/00.png", "c.png"), 1)
    extract_features(folder, tmp_path / "new.h5", FEW, workers=1)
    assert same_content(path, tmp_path / "new.h5")
    with pytest.raises(OptionError, match="`max_keypoints`"):
        extract_features(folder, path, workers=1)
    report = extract_features(folder, path, workers=1, overwrite=True)
    assert len(report.counts) == 3


def test_bad_images_do_not_stop_the_others(
    collection: Callable[..., Path], tmp_path: Path, same_content: Callable[..., bool]
) -> None:
    folder = collection(3)
    extract_features(folder, tmp_path / "good.h5", FEW, workers=1)
    (folder / "bad.png").write_bytes(b"not a photograph")
    (folder / os.fsdecode(b"\xff.png")).write_bytes((folder / "a/00.png").read_bytes())
    for workers, expected in ((2, (3, 0)), (1, (0, 3))):
        report = extract_features(folder, tmp_path / "f.h5", FEW, workers=workers)
        assert (len(report.counts), report.skipped) == expected
        assert len(report.failures) == 2
        assert "bad.png" in "".join(report.failures)
    assert same_content(tmp_path / "f.h5", tmp_path / "good.h5")
    (folder / "bad.png").write_bytes((folder / "a/00.png").read_bytes())
    assert list(extract_features(folder, tmp_path / "f.h5", FEW).counts) == ["bad.png"]


def test_images_that_are_gone_lose_their_features(
    collection: Callable[..., Path], tmp_path: Path
) -> None:
    import h5py

    def names() -> list[str]:
        with h5py.File(tmp_path / "f.h5") as file:
            return [f"{top}/{name}" for top in file for name in file[top]]

    folder = collection(4)
    extract_features(folder, tmp_path / "f.h5", FEW, workers=1)
    (folder / "a/00.png").write_bytes(b"not a photograph")
    report = extract_features(folder, tmp_path / "f.h5", FEW, workers=1)
    assert (tuple(report.counts), report.skipped, len(report.failures)) == ((), 3, 1)
    assert names() == ["a/02.png", "b/01.png", "b/03.png"]
    (folder / "b/03.png").unlink()
    extract_features(folder, tmp_path / "f.h5", FEW, workers=1)
    assert names() == ["a/02.png", "b/01.png"]


def test_an_image_that_is_too_large_is_a_failure(
    collection: Callable[..., Path], photo: np.ndarray, tmp_path: Path
) -> None:
    folder = collection(2)
    Image.fromarray(photo).save(folder / "large.png")
    report = extract_features(folder, tmp_path / "f.h5", FEW, workers=1, max_megapixels=0.02)
    assert list(report.counts) == ["a/00.png", "b/01.png"]
    (failure,) = report.failures
    assert "large.png" in failure


def test_weights_that_have_changed_are_loaded_again(
    collection: Callable[..., Path], tmp_path: Path, same_content: Callable[..., bool]
) -> None:
    folder, weights = collection(1), tmp_path / "weights.onnx"
    options: dict[str, Any] = {"selection": PIXELS, "workers": 1}
    for name in ("dense", "free"):
        weights.write_bytes(pretrained_weights(name).read_bytes())
        detector = DeepDetect(weights, threads=1)
        if name == "free":
            with pytest.raises(OptionError, match=r"other settings \(`weights`\)"):
                extract_features(folder, tmp_path / "f.h5", detector, **options)
        extract_features(folder, tmp_path / "f.h5", detector, **options, overwrite=True)
        own = DeepDetect(name, threads=1)
        extract_features(folder, tmp_path / f"{name}.h5", own, **options, overwrite=True)
        assert same_content(tmp_path / "f.h5", tmp_path / f"{name}.h5")
    assert not same_content(tmp_path / "dense.h5", tmp_path / "free.h5")


@pytest.mark.skipif(os.name != "posix", reason="needs process groups")
@pytest.mark.slow
def test_a_killed_run_goes_on(
    collection: Callable[..., Path], tmp_path: Path, same_content: Callable[..., bool]
) -> None:
    folder = collection(60)
    command = [sys.executable, "-m", "deepdetect", "extract", str(folder), "--workers", "2"]
    command += ["--max-keypoints", "500", "--json", "-o", str(tmp_path / "f.h5")]
    process = subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL)
    parts = tmp_path / "f.h5.shards"
    deadline = time.monotonic() + 120
    while len(list(parts.glob("*/[0-9a-f]*.h5"))) < 20:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    kept = len(list(parts.glob("*/[0-9a-f]*.h5")))
    assert 20 <= kept < 60
    assert not (tmp_path / "f.h5").exists()
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    report = json.loads(done.stdout)
    assert report["skipped"] == kept
    assert len(report["images"]) == 60 - kept
    assert not parts.exists()
    extract_features(folder, tmp_path / "whole.h5", PointDetector(500), workers=2)
    assert same_content(tmp_path / "f.h5", tmp_path / "whole.h5")


def test_positions_are_as_uncertain_as_the_network_sees_them(
    tmp_path: Path, photo: np.ndarray
) -> None:
    """hloc's `uncertainty` is the larger side of a pixel of the image that a model was given."""
    import h5py

    (tmp_path / "photos").mkdir()
    save_picture(photo[:96, :160], tmp_path / "photos" / "a.png")
    for resolution, expected in ((64, 2.5), ("auto", 1), ("native", 1)):
        detector, file = DeepDetect(resolution=resolution), tmp_path / f"{resolution}.h5"
        extract_features(tmp_path / "photos", file, detector, workers=1)
        with h5py.File(file, "r", libver="latest") as opened:
            assert opened["a.png"]["keypoints"].attrs["uncertainty"] == expected


@pytest.mark.filterwarnings("ignore:.*give the range")
def test_images_that_are_added_are_read_by_the_range_of_the_others(tmp_path: Path) -> None:
    values = np.random.default_rng(0).integers(7000, 7301, (120, 160)).astype(np.uint16)
    (tmp_path / "photos").mkdir()
    for number in (0, 1):
        Image.fromarray(values + 99 * number).save(tmp_path / f"photos/{number}.png")
        report = extract_features(tmp_path / "photos", tmp_path / "f.h5", FEW, workers=1)
        assert report.skipped == number
        assert len(report.counts) == 1
