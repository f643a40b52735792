from __future__ import annotations

import copy
import gc
import multiprocessing
import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from deepdetect import DeepDetect, Keypoints, PointDetector, SelectionOptions, match_images
from deepdetect._shared.errors import OptionError, WeightsError
from deepdetect.detector import HeatmapOptions
from deepdetect.detector.detector import find_keypoints
from deepdetect.detector.pretrained import pretrained_weights
from deepdetect.features import select_keypoints
from deepdetect.features.sift import root_sift_descriptors
from deepdetect.io import image as io_image

# The bundled weights change, so nothing here depends on the values that they give.

MakeOnnx = Callable[..., Path]
FREE_MAP = ("n", 1, "h", "w")


@pytest.fixture(scope="module")
def detector() -> DeepDetect:
    return DeepDetect(backend="onnxruntime", threads=1)


@pytest.fixture(params=["onnxruntime", "openvino"])
def backend(request: pytest.FixtureRequest) -> str:
    pytest.importorskip(request.param)
    return str(request.param)


@pytest.fixture(scope="module")
def image(photo: np.ndarray) -> np.ndarray:
    """A piece of the photograph whose sides are no multiples of 8."""
    return np.ascontiguousarray(photo[20:121, 60:197])


# The heat map.


def test_any_size_is_padded_with_its_border(detector: DeepDetect, image: np.ndarray) -> None:
    import onnxruntime

    session = onnxruntime.InferenceSession(str(pretrained_weights()))
    for height, width in ((16, 16), (31, 16), (33, 57)):
        rgb = image[:height, :width]
        heatmap = detector.heatmap(rgb)
        assert heatmap.shape == (height, width)
        assert heatmap.dtype == np.float32
        assert 0 <= heatmap.min() < heatmap.max() <= 1
        padded = np.pad(rgb, ((0, -height % 8), (0, -width % 8), (0, 0)), mode="edge")
        planes = (padded.transpose(2, 0, 1)[None] / 255).astype(np.float32)
        expected = session.run(None, {session.get_inputs()[0].name: planes})[0][0, 0]
        np.testing.assert_allclose(heatmap, expected[:height, :width], atol=1e-5)


def test_other_options_share_the_network(detector: DeepDetect, image: np.ndarray) -> None:
    options = HeatmapOptions(64, "bgr")
    other = detector.configured(options)
    fresh = DeepDetect(backend="onnxruntime", threads=1, resolution=64, network_channels="bgr")
    assert detector.heatmap_options == HeatmapOptions()
    assert other.heatmap_options == options
    assert other.backend == detector.backend
    np.testing.assert_array_equal(other.heatmap(image), fresh.heatmap(image))


@pytest.mark.parametrize("resolution", ["native", 64])
def test_a_constant_image_has_no_keypoint(resolution: str | int, detector: DeepDetect) -> None:
    flat = detector.configured(HeatmapOptions(resolution))
    for given in (np.full((17, 23, 3), 60, np.uint8), np.full((48, 61), 1.0)):
        assert not flat.heatmap(given).any()
        assert len(flat.detect(given, 0.0)) == 0
        assert len(flat.detect(given, density=1.0, nms_radius=2)) == 0


# The keypoints.


@pytest.mark.parametrize(
    "options",
    [
        {"max_keypoints": 50},
        {"density": 0.3, "nms_radius": 2},
        {"threshold": 0.1, "nms_radius": 3, "max_keypoints": 20},
    ],
)
def test_detection_is_selection_from_the_map(
    options: dict[str, Any], detector: DeepDetect, image: np.ndarray
) -> None:
    heatmap, logits = detector.heatmap_and_logits(image)
    np.testing.assert_array_equal(heatmap, detector.heatmap(image))
    keypoints = detector.detect(image, **options)
    expected = select_keypoints(heatmap, SelectionOptions(**options), logits)
    np.testing.assert_array_equal(keypoints.xy, expected.xy)
    np.testing.assert_array_equal(keypoints.logits, expected.logits)
    assert keypoints.image_size == (image.shape[1], image.shape[0])
    x, y = np.rint(keypoints.xy).astype(int).T
    np.testing.assert_array_equal(keypoints.scores, heatmap[y, x])


# Backends.


@pytest.mark.parametrize("other", ["onnxruntime", "openvino"])
def test_backends_agree(other: str, detector: DeepDetect, image: np.ndarray) -> None:
    pytest.importorskip(other)
    second = DeepDetect(backend=other, threads=1)
    assert second.backend == other
    pieces = (image, image[8:, :], image[:17, :23])
    # All first: a map is not to be overwritten by the next.
    for piece, heatmap in zip(pieces, [second.heatmap(piece) for piece in pieces], strict=True):
        assert heatmap.dtype == np.float32
        assert np.abs(heatmap - detector.heatmap(piece)).max() < 1e-3


def test_the_automatic_backend() -> None:
    pytest.importorskip("openvino")
    assert DeepDetect().backend == "onnxruntime"
    try:
        assert DeepDetect(precision="bfloat16").backend == "openvino"
    except OptionError:
        pytest.skip("needs a processor with bfloat16")


@pytest.mark.parametrize(
    "arguments",
    [
        {"backend": "onnx"},
        {"threads": 1.5},
        {"device": "CUDAExecutionProvidr"},
        {"device": "cuda", "backend": "openvino"},
        {"precision": "bfloat16", "backend": "onnxruntime"},
        {"precision": "bfloat16", "device": "cuda"},
    ],
)
def test_wrong_options(arguments: dict[str, Any]) -> None:
    with pytest.raises(OptionError):
        DeepDetect(**arguments)


# Weights that are wrong.


def write_half(path: Path) -> None:
    content = pretrained_weights().read_bytes()
    path.write_bytes(content[: len(content) // 2])


def write_words(path: Path) -> None:
    path.write_text("These are words.\nAnd more of them.\n")


BAD_WEIGHTS = {
    "none.onnx": None,
    "half.onnx": write_half,
    "words.onnx": write_words,
    "words.safetensors": write_words,
}


@pytest.mark.parametrize(
    ("name", "backend"),
    [(name, backend) for name in BAD_WEIGHTS for backend in ("auto", "onnxruntime")],
)
def test_wrong_weights(
    name: str,
    backend: str,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    write = BAD_WEIGHTS[name]
    if write is not None:
        write(tmp_path / name)
    with pytest.raises(WeightsError, match=name):
        DeepDetect(tmp_path / name, backend=backend)
    printed = capfd.readouterr()
    assert printed.out == printed.err == ""


def test_an_onnx_file_that_fits(onnx_file: MakeOnnx, image: np.ndarray) -> None:
    heatmap = DeepDetect(str(onnx_file()), backend="onnxruntime").heatmap(image)
    np.testing.assert_allclose(heatmap, image.mean(2) / 255, atol=1e-6)


NAN = (("Mul", "minus"), ("Sub", "five"), ("Log", ""))
BAD_NETWORKS: dict[str, tuple[Sequence[tuple[str, str]], dict[str, Any]]] = {
    "one channel": ((), {"given": FREE_MAP}),
    "one size only": ((), {"given": (1, 3, 64, 64), "result": (1, 1, 64, 64)}),
    "double precision": ((), {"kind": "DOUBLE"}),
    "half": ((("AveragePool", ""),), {"kernel_shape": [2, 2], "strides": [2, 2]}),
    "twice as wide": ((("Tile", "repeats"),), {}),
    "not finite": (NAN, {"output": "logits"}),
    "no probabilities": ((("Add", "five"),), {}),
    "constant": ((("Sub", "mean"),), {"output": "logits"}),
}


@pytest.mark.parametrize("name", BAD_NETWORKS)
def test_a_network_that_does_not_fit(name: str, backend: str, onnx_file: MakeOnnx) -> None:
    nodes, options = BAD_NETWORKS[name]
    path = onnx_file(*nodes, **options)
    with pytest.raises(WeightsError, match=path.name):
        DeepDetect(path, backend=backend)


def test_a_network_that_answers_wrongly_later(backend: str, onnx_file: MakeOnnx) -> None:
    """Finite on what a network is tried on, which is never black."""
    detector = DeepDetect(onnx_file(("Div", "mean"), ("Mul", "mean")), backend=backend)
    image = np.random.default_rng(0).integers(1, 256, (48, 64, 3), np.uint8)
    assert detector.heatmap(image).shape == (48, 64)
    image[7, 9] = 0
    with pytest.raises(WeightsError):
        detector.detect(image)


def test_threads_get_their_own_images(backend: str) -> None:
    from concurrent.futures import ThreadPoolExecutor

    detector = DeepDetect(backend=backend, threads=1)
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (48 + 8 * k, 64, 3), np.uint8) for k in range(4)] * 4
    alone = [detector.heatmap(image) for image in images]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(detector.heatmap, images))
    for expected, found in zip(alone, together, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-5)


# Too little memory, and memory that grows.

SHORT_OF_MEMORY = """
import resource, sys
import numpy as np
from deepdetect import DeepDetect, DeepDetectError
detector = DeepDetect(sys.argv[1], backend=sys.argv[2], resolution="native", threads=1)
image = np.random.default_rng(0).integers(0, 256, (1200, 1600, 3), np.uint8)
expected = detector.heatmap(image[:64, :64])
before = resource.getrlimit(resource.RLIMIT_AS)
for megabytes in (10, 80):
    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + megabytes * 1_000_000, before[1]))
    try:
        detector.detect(image)
        print("whole")
    except DeepDetectError as error:
        print(error)
    resource.setrlimit(resource.RLIMIT_AS, before)  # the next image is not to suffer for it
    np.testing.assert_array_equal(detector.heatmap(image[:64, :64]), expected)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs a limit on memory that holds")
@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
def test_too_little_memory_is_one_sentence(backend: str) -> None:
    pytest.importorskip(backend)
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    words = [sys.executable, "-c", SHORT_OF_MEMORY, "default", backend]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("1600x1200") == 2


def test_bfloat16_moves_few_keypoints(image: np.ndarray) -> None:
    openvino = pytest.importorskip("openvino")
    if "BF16" not in openvino.Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES"):
        with pytest.raises(OptionError):
            DeepDetect(precision="bfloat16")
        return
    exact, quick = DeepDetect(backend="openvino"), DeepDetect(precision="bfloat16")
    assert (exact.runtime, quick.runtime) == ("openvino", "openvino, bfloat16")
    assert repr(quick).endswith("backend='openvino, bfloat16')")
    assert quick.with_weights("dense").runtime == quick.configured(HeatmapOptions(480)).runtime
    expected, found = exact.heatmap(image), quick.heatmap(image)
    difference = np.abs(found - expected)
    assert 1e-5 < difference.max() < 0.2
    assert ((found > 0.5) != (expected > 0.5)).mean() < 0.01


@pytest.mark.parametrize(
    "heatmap", [np.full((48, 64), np.nan, np.float32), np.zeros((24, 32), np.float32)]
)
def test_a_heat_map_of_somebody_s_own_detector(heatmap: np.ndarray) -> None:
    class Own:
        def heatmap(self, image: Any) -> np.ndarray:
            return heatmap

    image = np.zeros((48, 64, 3), np.uint8)
    with pytest.raises(OptionError):
        match_images(image, image, Own())


def test_a_network_is_loaded_once_until_its_file_changes(
    tmp_path: Path, image: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = Path("own.onnx")
    path.write_bytes(pretrained_weights("default").read_bytes())
    first, again = (DeepDetect(path, backend="onnxruntime") for _ in range(2))
    assert first._network is again._network
    assert DeepDetect(path, backend="onnxruntime", threads=1)._network is not first._network
    path.write_bytes(pretrained_weights("dense").read_bytes())
    os.utime(path, ns=(1, 1))
    changed = DeepDetect(path, backend="onnxruntime").heatmap(image)
    np.testing.assert_array_equal(
        changed, DeepDetect("dense", backend="onnxruntime").heatmap(image)
    )
    assert not np.array_equal(changed, first.heatmap(image))


@pytest.mark.parametrize("weights", ["default", pretrained_weights("dense")])
def test_a_detector_goes_to_other_processes(weights: Any, image: np.ndarray) -> None:
    detector = DeepDetect(weights, backend="onnxruntime", threads=1, network_channels="bgr")
    other = pickle.loads(pickle.dumps(detector.configured(HeatmapOptions(64, "bgr"))))
    assert other.settings == {**detector.settings, "resolution": 64}
    np.testing.assert_allclose(
        other.heatmap(image), detector.configured(HeatmapOptions(64, "bgr")).heatmap(image)
    )


class OwnDetector(DeepDetect):
    """A subclass with a signature of its own."""

    def __init__(self) -> None:
        super().__init__("dense", threads=1)
        self.note = "kept"


@pytest.mark.parametrize("how", [copy.copy, copy.deepcopy, lambda d: pickle.loads(pickle.dumps(d))])
def test_copies_detect_the_same(how: Any, image: np.ndarray) -> None:
    for detector in (OwnDetector(), PointDetector(20, spread="grid")):
        other = how(detector)
        assert type(other) is type(detector)
        assert getattr(other, "note", "") == getattr(detector, "note", "")
        np.testing.assert_array_equal(other.detect(image).xy, detector.detect(image).xy)


@pytest.mark.parametrize("method", multiprocessing.get_all_start_methods())
def test_pools_map_the_methods_of_detectors(method: str, image: np.ndarray) -> None:
    points = PointDetector(20)
    gc.collect()  # sessions of earlier tests, which a forked process waits for when it ends them
    context = multiprocessing.get_context(method)
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        found = next(pool.map(points.detect, [image]))
    np.testing.assert_array_equal(found.xy, points.detect(image).xy)


@pytest.mark.parametrize("program", ["joblib", "ray"])
def test_joblib_and_ray_map_the_methods_of_detectors(program: str, image: np.ndarray) -> None:
    module = pytest.importorskip(program)
    for detector in (PointDetector(20), DeepDetect(threads=1)):
        if program == "joblib":
            call = module.delayed(detector.detect)
            found = module.Parallel(n_jobs=2)(call(each) for each in [image, image])
        else:
            module.init(num_cpus=1, include_dashboard=False, ignore_reinit_error=True)
            detect = module.remote(lambda own, rgb: own.detect(rgb))
            found = module.get([detect.remote(detector, image)])
        for each in found:
            np.testing.assert_array_equal(each.xy, detector.detect(image).xy)


def test_the_number_of_keypoints_is_that_of_the_call_or_else_of_the_detector(
    image: np.ndarray,
) -> None:
    few = DeepDetect(max_keypoints=12)
    best = DeepDetect().detect(image, max_keypoints=12)
    np.testing.assert_array_equal(few.detect(image).xy, best.xy)
    np.testing.assert_array_equal(few.extract(image).xy, best.xy)
    assert len(few.detect(image, max_keypoints=30)) == 30
    assert [len(each) for each in few.detect_batch([image, image])] == [12, 12]
    assert len(few.detect_batch([image], max_keypoints=5)[0]) == 5
    np.testing.assert_array_equal(find_keypoints(few, image).xy, best.xy)
    others = pickle.loads(pickle.dumps(few)), few.with_weights("default")
    for other in (*others, few.configured(HeatmapOptions())):
        assert other.settings == few.settings
        assert len(other.detect(image)) == 12
    assert few.settings["max_keypoints"] == 12
    with pytest.raises(OptionError, match="max_keypoints"):
        DeepDetect(max_keypoints=0)


def test_extracted_keypoints_are_the_detected_ones_described(
    detector: DeepDetect, image: np.ndarray
) -> None:
    found, expected = (call(image, 0.9) for call in (detector.extract, detector.detect))
    np.testing.assert_array_equal(found.xy, expected.xy)
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    np.testing.assert_array_equal(found.descriptors, root_sift_descriptors(gray, found.xy))
    assert found.descriptor_type == found[:3].descriptor_type == "rootsift"


def test_images_are_read_once(
    detector: DeepDetect, image: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = [tmp_path / "first.png", tmp_path / "second.png"]
    for path in paths:
        cv2.imwrite(str(path), image)
    opened: list[Any] = []
    read_file = io_image._read_file

    def counted(source: Any, *options: Any) -> np.ndarray:
        opened.append(source)
        return read_file(source, *options)

    monkeypatch.setattr(io_image, "_read_file", counted)
    detector.detect(paths[0])
    PointDetector(50).extract(paths[0])
    assert opened == [paths[0]] * 2
    opened.clear()
    match_images(*paths, PointDetector(300))
    assert opened == paths


@pytest.mark.parametrize(
    ("place", "inside"),
    [
        ((-0.5, -0.5), True),
        ((136.4, 100.4), True),
        ((136.5, 3), False),
        ((3, 100.5), False),
        ((-0.6, 3), False),
    ],
)
def test_keypoints_of_other_detectors_lie_in_pixels_of_the_image(
    place: tuple[float, float], inside: bool, image: np.ndarray
) -> None:
    """A pixel reaches from -0.5 to below 0.5 around its centre."""
    found = Keypoints([place], [1], (137, 101))
    other = SimpleNamespace(detect=lambda rgb, ignore=None: found)
    if inside:
        assert find_keypoints(other, image) is found
        return
    with pytest.raises(OptionError):
        find_keypoints(other, image)
