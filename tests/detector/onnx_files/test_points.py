"""Files that give points give those of `PointDetector`, in other runtimes, too."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

onnx = pytest.importorskip("onnx", reason="needs onnx, which is for exporting only")

import onnxruntime  # noqa: E402

from deepdetect import OptionError, PointDetector, load_image  # noqa: E402
from deepdetect.detector.onnx_files.export import OnnxOptions, write_onnx  # noqa: E402
from deepdetect.detector.pretrained import POINTS  # noqa: E402

NEAR_PX = 0.05
"""From a point of Python at which one of a file is the same. Its size is the same, too."""

LEAST_SHARE = 0.97
"""At least this fraction of a photograph's points is the same. In nearly uniform areas, rounding
decides where the maxima are."""

SIZES = [(16, 17), (101, 99), (20, 250), (200, 256)]
"""Heights and widths: smaller than the largest Gaussian, with fewer points than the file gives."""

Run = Callable[[np.ndarray], list[np.ndarray]]


def planes_of(*images: np.ndarray) -> np.ndarray:
    """Return (B, 3, H, W) float32, as the file takes images of one size."""
    return np.ascontiguousarray(np.stack(images).transpose(0, 3, 1, 2) * np.float32(1 / 255))


def open_in(runtime: str, path: Path, outputs: tuple[str, ...] = POINTS) -> Run:
    """Return what computes outputs of a file, by default keypoints, scores, sizes and angles."""
    if runtime.startswith("openvino"):
        openvino = pytest.importorskip("openvino", reason="needs OpenVINO")
        core, settings = openvino.Core(), {"INFERENCE_NUM_THREADS": 1}
        if runtime == "openvino":
            settings["INFERENCE_PRECISION_HINT"] = "f32"
        elif "BF16" not in core.get_property("CPU", "OPTIMIZATION_CAPABILITIES"):
            pytest.skip("needs a processor with bfloat16")
        model = core.compile_model(str(path), "CPU", settings)

        def run(images: np.ndarray) -> list[np.ndarray]:
            found = model([images])
            return [found[name] for name in outputs]

        return run
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads, settings.log_severity_level = 1, 4
    session = onnxruntime.InferenceSession(str(path), settings)
    return lambda images: session.run(outputs, {"image": images})


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file for any size that gives points alone."""
    made = tmp_path_factory.mktemp("points") / "points.onnx"
    write_onnx("default", made, OnnxOptions(maps=False))
    onnx.checker.check_model(onnx.load(made), full_check=True)
    return made


@pytest.fixture(scope="module", params=["onnxruntime", "openvino", "openvino in bfloat16"])
def run(request: pytest.FixtureRequest, path: Path) -> Run:
    return open_in(request.param, path)


def share(found: Any, number: int, rgb: np.ndarray, count: int = 2048) -> float:
    """Check the order and what is behind the last point; return the share of Python's points."""
    xy, scores, sizes, angles = (each[number] for each in found)
    assert xy.shape == (count, 2)
    assert scores.shape == sizes.shape == angles.shape == (count,)
    expected = PointDetector(count).detect(rgb)
    assert expected.sizes is not None
    assert expected.angles is not None
    here = int((scores > 0).sum())
    assert abs(here - len(expected)) <= (1 - LEAST_SHARE) * max(here, len(expected))
    assert (np.diff(scores) <= 0).all()
    assert (xy[here:] == -1).all()
    assert (sizes[here:] == 0).all()
    assert (angles[here:] == 0).all()
    if not here:
        return 1.0
    # Sizes differ by at least a pixel, so that levels lie apart as a third coordinate.
    places = np.column_stack([expected.xy, expected.sizes])
    distances, nearest = cKDTree(np.column_stack([xy, sizes])[:here]).query(places)
    same = distances < NEAR_PX
    differences = np.abs(scores[nearest[same]] - expected.scores[same])
    assert np.median(differences) < 1e-4
    turns = np.abs((angles[nearest[same]] - expected.angles[same] + 180) % 360 - 180)
    assert np.mean(turns < 1) > 0.99
    return float(same.mean())


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_they_are_what_the_detector_finds(
    height: int, width: int, run: Run, photo: np.ndarray
) -> None:
    rgb = photo[:height, :width]
    assert share(run(planes_of(rgb)), 0, rgb) > 0.99


def test_a_batch_gives_those_of_each_image(run: Run, photo: np.ndarray) -> None:
    images = [photo[:123, :157], photo[100:223, 60:217].copy(), np.full((123, 157, 3), 7, "u1")]
    images[1][:, 30:] = 128  # fewer points
    found = run(planes_of(*images))
    for k, rgb in enumerate(images):
        assert share(found, k, rgb) > 0.98
        for together, alone in zip(found, run(planes_of(rgb)), strict=True):
            np.testing.assert_allclose(together[k], alone[0], atol=1e-4)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (2, 30), (3, 3), (9, 4)])
def test_the_smallest_images_have_none(shape: tuple[int, int], run: Run) -> None:
    image = np.random.default_rng(0).random((1, 3, *shape), np.float32)
    xy, scores, *_ = run(image)
    assert scores.max() == 0
    assert xy.max() == -1


@pytest.mark.parametrize("size", [None, (123, 157)])
def test_points_beside_maps_are_right_in_bfloat16(
    size: tuple[int, int] | None, tmp_path: Path, photo: np.ndarray
) -> None:
    made, rgb = tmp_path / "both.onnx", photo[:123, :157]
    write_onnx("default", made, OnnxOptions(size, max_keypoints=300))
    assert share(open_in("openvino in bfloat16", made)(planes_of(rgb)), 0, rgb, 300) > 0.98


def test_one_size_with_maps(tmp_path: Path, photo: np.ndarray) -> None:
    made = tmp_path / "one.onnx"
    options = OnnxOptions((123, 157), 2, max_keypoints=300)
    assert write_onnx("default", made, options)["max_keypoints"] == "300"
    onnx.checker.check_model(onnx.load(made), full_check=True)
    shapes = {
        value.name: [side.dim_value for side in value.type.tensor_type.shape.dim]
        for value in onnx.load(made).graph.output
    }
    assert list(shapes) == ["probability", "logits", *POINTS]
    assert shapes["keypoints"] == [2, 300, 2]
    assert shapes["scores"] == shapes["sizes"] == shapes["angles"] == [2, 300]
    images = [photo[:123, :157], photo[9:132, 5:162]]
    found = open_in("onnxruntime", made)(planes_of(*images))
    for k, rgb in enumerate(images):
        assert share(found, k, rgb, 300) > 0.98


def test_a_file_is_made_of_such_a_file(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("both.onnx", "fewer.onnx", "expected.onnx")]
    write_onnx("default", files[0])
    write_onnx(files[0], files[1], OnnxOptions(max_keypoints=7))
    write_onnx("default", files[2], OnnxOptions(max_keypoints=7))
    assert files[1].read_bytes() == files[2].read_bytes()


@pytest.mark.slow
def test_photographs(run: Run, shared: Path) -> None:
    files = sorted((shared / "data/photos/val").iterdir())[::8]
    crops = [load_image(file) for file in files]
    for scene in ("graf", "bikes", "leuven", "trees"):
        for number in (1, 4, 6):
            image = load_image(shared / f"data/oxford/{scene}/img{number}.png")
            crops.append(np.ascontiguousarray(image[:480, :640]))
    shares = [share(run(planes_of(rgb)), 0, rgb) for rgb in crops]
    assert min(shares) >= LEAST_SHARE
    assert np.mean(shares) > 0.99


@pytest.mark.parametrize("runtime", ["onnxruntime", "openvino"])
@pytest.mark.parametrize("descriptor", ["learned", "learned-free"])
def test_descriptors_beside_points(
    runtime: str, descriptor: str, tmp_path: Path, photo: np.ndarray
) -> None:
    path = tmp_path / "described.onnx"
    written = write_onnx("default", path, OnnxOptions(max_keypoints=200, descriptor=descriptor))
    assert written["descriptor"] == descriptor
    images = [photo[:123, :157], photo[100:223, 60:217].copy()]
    images[1][:, 30:] = 128  # fewer points
    run = open_in(runtime, path, (*POINTS, "descriptors"))
    xy, scores, sizes, _, codes = run(planes_of(*images))
    assert codes.shape == (2, 200, 64)
    assert (scores[1] == 0).any()
    assert not codes[scores == 0].any()
    for k, image in enumerate(images):
        expected = PointDetector(200, descriptor=descriptor).extract(image)
        places = np.column_stack([expected.xy, expected.sizes])
        found = scores[k] > 0
        distances, nearest = cKDTree(np.column_stack([xy[k], sizes[k]])[found]).query(places)
        same = distances < NEAR_PX
        assert same.mean() > LEAST_SHARE
        alike = (codes[k][nearest[same]] * expected.descriptors[same]).sum(axis=1)
        assert np.quantile(alike, 0.05) > 0.999
    # The network alone can be taken out of the file again.
    write_onnx(path, tmp_path / "maps.onnx", OnnxOptions(max_keypoints=0))
    write_onnx("default", tmp_path / "plain.onnx", OnnxOptions(max_keypoints=0))
    maps, plain = (onnx.load(tmp_path / f"{name}.onnx").graph for name in ("maps", "plain"))
    assert maps == plain


@pytest.mark.parametrize(
    "options", [{"descriptor": "rootsift"}, {"descriptor": "learned", "max_keypoints": 0}]
)
def test_descriptors_that_no_file_can_give(options: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match="descriptor"):
        OnnxOptions(**options)
