from __future__ import annotations

import contextlib
import importlib.util
import io
import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from deepdetect import DeepDetect, PointDetector, SelectionOptions, load_image, match_images
from deepdetect._shared.errors import OptionError, WeightsError
from deepdetect.detector import HeatmapOptions
from deepdetect.detector.pretrained import pretrained_weights
from deepdetect.features import select_keypoints
from deepdetect.features.sift import root_sift_descriptors

# The bundled weights change, so nothing here depends on the values that they give.

OneLine = Callable[[BaseException], str]
INSTALLED = {
    name: importlib.util.find_spec(name) is not None
    for name in ("onnx", "onnxruntime", "openvino", "safetensors", "torch")
}
needs = {
    name: pytest.mark.skipif(not there, reason=f"needs {name}, which is not installed")
    for name, there in INSTALLED.items()
}
TORCH_WEIGHTS = pretrained_weights().with_suffix(".safetensors")


@pytest.fixture(scope="module")
def detector() -> DeepDetect:
    return DeepDetect(backend="onnxruntime")


@pytest.fixture
def torch_threads() -> Iterator[None]:
    """Give torch its number of threads back, which a detector sets for the whole process."""
    if not INSTALLED["torch"]:
        yield
        return
    import torch

    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def image(photo: np.ndarray) -> np.ndarray:
    """A piece of the photograph whose sides are no multiples of 8."""
    return np.ascontiguousarray(photo[20:121, 60:197])


def run_by_hand(rgb: np.ndarray) -> np.ndarray:
    """The bundled network on an image whose sides are multiples of 8, without the package."""
    import onnxruntime

    session = onnxruntime.InferenceSession(
        str(pretrained_weights()), providers=["CPUExecutionProvider"]
    )
    planes = (rgb.transpose(2, 0, 1)[None] / 255).astype(np.float32)
    return session.run(None, {session.get_inputs()[0].name: planes})[0][0, 0]


# The heat map.


@pytest.mark.parametrize("shape", [(16, 16), (17, 23), (24, 40), (31, 16), (33, 57), (101, 64)])
def test_any_size_is_padded_with_its_border(
    shape: tuple[int, int], detector: DeepDetect, image: np.ndarray
) -> None:
    rgb = image[: shape[0], : shape[1]]
    heatmap = detector.heatmap(rgb)
    assert heatmap.shape == shape
    assert heatmap.dtype == np.float32
    assert 0 <= heatmap.min() < heatmap.max() <= 1
    below, right = -shape[0] % 8, -shape[1] % 8
    padded = cv2.copyMakeBorder(rgb, 0, below, 0, right, cv2.BORDER_REPLICATE)
    np.testing.assert_allclose(heatmap, run_by_hand(padded)[: shape[0], : shape[1]], atol=1e-5)


def test_other_options_share_the_network(detector: DeepDetect, image: np.ndarray) -> None:
    options = HeatmapOptions(64, "bgr")
    other = detector.configured(options)
    fresh = DeepDetect(backend="onnxruntime", resolution=64, network_channels="bgr")
    assert detector.heatmap_options == HeatmapOptions()
    assert other.heatmap_options == options
    assert other.backend == detector.backend
    np.testing.assert_array_equal(other.heatmap(image), fresh.heatmap(image))


KINDS = {
    "path": lambda rgb, path: path,
    "text path": lambda rgb, path: str(path),
    "bytes": lambda rgb, path: path.read_bytes(),
    "file": lambda rgb, path: io.BytesIO(path.read_bytes()),
    "uint16": lambda rgb, path: rgb.astype(np.uint16) * 257,
    "float64": lambda rgb, path: rgb / 255,
    "float32": lambda rgb, path: (rgb / 255).astype(np.float32),
    "rgba": lambda rgb, path: np.dstack([rgb, rgb[:, :, :1]]),
}


@pytest.mark.parametrize("kind", KINDS)
def test_inputs_of_every_kind_give_the_same_map(
    kind: str, detector: DeepDetect, photo: np.ndarray, photo_path: Path
) -> None:
    np.testing.assert_array_equal(
        detector.heatmap(KINDS[kind](photo, photo_path)), detector.heatmap(photo)
    )


@pytest.mark.parametrize("resolution", ["native", 64])
@pytest.mark.parametrize("level", [0, 1, 60, 128, 254, 255])
def test_a_constant_image_has_no_keypoint(
    level: int, resolution: str | int, detector: DeepDetect
) -> None:
    flat = detector.configured(HeatmapOptions(resolution))
    for given in (
        np.full((48, 61), level, np.uint8),
        np.full((17, 23, 3), level, np.uint8),
        np.full((48, 61), level / 255),
    ):
        assert not flat.heatmap(given).any()
        assert len(flat.detect(given, 0.0)) == 0
        assert len(flat.detect(given, density=0.5)) == 0
        assert len(flat.detect(given, density=1.0, nms_radius=2)) == 0


# The keypoints.


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"threshold": 0.3},
        {"max_keypoints": 50},
        {"density": 0.1},
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


def open_backends() -> list[Any]:
    weights = {"onnxruntime": pretrained_weights(), "openvino": pretrained_weights()}
    weights["torch"] = TORCH_WEIGHTS
    return [pytest.param(name, path, id=name, marks=needs[name]) for name, path in weights.items()]


@pytest.mark.usefixtures("torch_threads")
@pytest.mark.parametrize(("backend", "weights"), open_backends())
def test_backends_agree(
    backend: str, weights: Path, detector: DeepDetect, image: np.ndarray
) -> None:
    other = DeepDetect(weights, backend=backend, threads=1)
    assert other.backend == backend
    for given in (image, image[:17, :23]):
        heatmap = other.heatmap(given)
        assert heatmap.dtype == np.float32
        assert np.abs(heatmap - detector.heatmap(given)).max() < 1e-3


@pytest.mark.usefixtures("torch_threads")
@pytest.mark.parametrize(("backend", "weights"), open_backends())
def test_a_map_is_not_overwritten_by_the_next(
    backend: str, weights: Path, photo: np.ndarray
) -> None:
    detector = DeepDetect(weights, backend=backend, threads=1)
    first = detector.heatmap(photo[:64, :64])
    before = first.copy()
    detector.heatmap(photo[64:128, 64:128])
    np.testing.assert_array_equal(first, before)


def hide(monkeypatch: pytest.MonkeyPatch, *packages: str) -> None:
    """Make packages look as if they were not installed."""
    find = importlib.util.find_spec

    def find_others(name: str, package: str | None = None) -> object:
        return None if name.partition(".")[0] in packages else find(name, package)

    monkeypatch.setattr(importlib.util, "find_spec", find_others)
    for package in packages:
        monkeypatch.setitem(sys.modules, package, None)
        for name in [name for name in sys.modules if name.startswith(f"{package}.")]:
            monkeypatch.setitem(sys.modules, name, None)


def test_the_automatic_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    assert DeepDetect().backend == ("openvino" if INSTALLED["openvino"] else "onnxruntime")
    assert DeepDetect(device="CPUExecutionProvider").backend == "onnxruntime"
    hide(monkeypatch, "openvino")
    assert DeepDetect().backend == "onnxruntime"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"backend": "onnx"}, "unknown backend 'onnx': did you mean 'onnxruntime'?"),
        ({"backend": "torch"}, "torch reads .safetensors files, not default.onnx"),
        (
            {"backend": "onnxruntime", "weights": TORCH_WEIGHTS},
            "onnxruntime reads .onnx files, not default.safetensors",
        ),
        ({"threads": 0}, "threads must be at least 1, not 0"),
        (
            {"device": "CUDAExecutionProvidr"},
            "unknown device 'CUDAExecutionProvidr': did you mean 'CUDAExecutionProvider'?",
        ),
        (
            {"device": "cuda", "backend": "openvino"},
            '`device="cuda"` needs the backend onnxruntime, not openvino',
        ),
        (
            {"precision": "bfloat16", "backend": "onnxruntime"},
            '`precision="bfloat16"` needs the backend openvino, not onnxruntime',
        ),
        (
            {"precision": "bfloat16", "weights": TORCH_WEIGHTS},
            "needs the backend openvino, not torch",
        ),
        (
            {"precision": "bfloat16", "device": "cuda"},
            '`precision="bfloat16"` needs openvino, and `device="cuda"` onnxruntime',
        ),
        # Torch alone reads these weights.
        (
            {"device": "cuda", "weights": TORCH_WEIGHTS},
            '`device="cuda"` needs the backend onnxruntime, not torch',
        ),
        ({"resolution": 100}, "multiple of 8"),
        ({"network_channels": "grb"}, "unknown channel order 'grb'"),
    ],
)
def test_wrong_options(arguments: dict[str, Any], words: str, one_line: OneLine) -> None:
    with pytest.raises(OptionError) as caught:
        DeepDetect(**arguments)
    assert words in one_line(caught.value)


# Weights that are wrong.


def text(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_text("These are words.\nAnd more of them.\n")
        return folder / name

    return make


def half(suffix: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        content = pretrained_weights().with_suffix(suffix).read_bytes()
        (folder / f"half{suffix}").write_bytes(content[: len(content) // 2])
        return folder / f"half{suffix}"

    return make


def wrong_shape(folder: Path) -> Path:
    """The bundled tensors, one of them one channel too wide."""
    numpy = pytest.importorskip("safetensors.numpy")
    tensors = numpy.load_file(TORCH_WEIGHTS)
    name = sorted(name for name, value in tensors.items() if value.ndim == 4)[0]
    tensors[name] = np.concatenate([tensors[name], tensors[name][:1]])
    numpy.save_file(tensors, folder / "wide.safetensors")
    return folder / "wide.safetensors"


def onnx_file(
    given: Sequence[int | str], result: Sequence[int | str], kind: str = "FLOAT"
) -> Callable[[Path], Path]:
    """Make an ONNX file of a mean over the channels, or of nothing where the shapes are equal."""

    def make(folder: Path) -> Path:
        onnx = pytest.importorskip("onnx")
        helper = onnx.helper
        element = getattr(onnx.TensorProto, kind)
        if given == result:
            node = helper.make_node("Identity", ["image"], ["map"])
        else:
            node = helper.make_node("ReduceMean", ["image"], ["map"], axes=[1], keepdims=1)
        graph = helper.make_graph(
            [node],
            "graph",
            [helper.make_tensor_value_info("image", element, given)],
            [helper.make_tensor_value_info("map", element, result)],
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
        model.ir_version = 8
        onnx.save(model, str(folder / "made.onnx"))
        return folder / "made.onnx"

    return make


FREE_IMAGE, FREE_MAP = ("n", 3, "h", "w"), ("n", 1, "h", "w")
BAD_ONNX = {
    "missing": (lambda folder: folder / "none.onnx", "there is no weights file"),
    "half": (half(".onnx"), "is not an ONNX file that can be read"),
    "one channel": (onnx_file(FREE_MAP, FREE_MAP), "does not fit"),
    "one size only": (onnx_file((1, 3, 64, 64), (1, 1, 64, 64)), "does not fit"),
    "two images at once": (onnx_file((2, 3, "h", "w"), (2, 1, "h", "w")), "does not fit"),
    "double precision": (onnx_file(FREE_IMAGE, FREE_MAP, "DOUBLE"), "does not fit"),
}
BAD_SAFETENSORS = {
    "missing": (lambda folder: folder / "none.safetensors", "there is no weights file"),
    "half": (half(".safetensors"), "does not fit the network"),
    "wrong shape": (wrong_shape, "does not fit the network"),
}
BAD_WEIGHTS = [
    *(
        pytest.param(*case, backend, id=f"{backend}: {name}", marks=needs[backend])
        for name, case in BAD_ONNX.items()
        for backend in ("onnxruntime", "openvino")
    ),
    *(
        pytest.param(
            *case, "torch", id=f"torch: {name}", marks=[needs["torch"], needs["safetensors"]]
        )
        for name, case in BAD_SAFETENSORS.items()
    ),
    *(
        pytest.param(text(name), "must end in .onnx or .safetensors", "auto", id=f"auto: {name}")
        for name in ("weights.pth", "weights")
    ),
]


@pytest.mark.parametrize(("make", "words", "backend"), BAD_WEIGHTS)
def test_wrong_weights(
    make: Callable[[Path], Path], words: str, backend: str, tmp_path: Path, one_line: OneLine
) -> None:
    path = make(tmp_path)
    with pytest.raises(WeightsError) as caught:
        DeepDetect(path, backend=backend)
    message = one_line(caught.value)
    assert words in message
    assert str(path) in message


@needs["onnx"]
def test_an_onnx_file_that_fits(tmp_path: Path, image: np.ndarray) -> None:
    path = onnx_file(FREE_IMAGE, FREE_MAP)(tmp_path)
    heatmap = DeepDetect(str(path), backend="onnxruntime").heatmap(image)
    np.testing.assert_allclose(heatmap, image.mean(2) / 255, atol=1e-6)


@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
def test_threads_get_their_own_images(backend: str) -> None:
    pytest.importorskip(backend, reason=f"needs {backend}")
    from concurrent.futures import ThreadPoolExecutor

    detector = DeepDetect(backend=backend, threads=1)
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (48 + 8 * k, 64, 3), np.uint8) for k in range(4)] * 4
    alone = [detector.heatmap(image) for image in images]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(detector.heatmap, images))
    for expected, found in zip(alone, together, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-5)


# What a network may answer.


def bad_answer(folder: Path, kind: str) -> Path:
    """Write an ONNX file that fits by its declared shapes, and answers wrongly."""
    onnx = pytest.importorskip("onnx")
    helper, element = onnx.helper, onnx.TensorProto.FLOAT
    mean = helper.make_node("ReduceMean", ["image"], ["mean"], axes=[1], keepdims=1)
    constant = {
        name: onnx.numpy_helper.from_array(np.array(value, np.float32), name)
        for name, value in (("minus", -1.0), ("five", 5.0))
    }
    repeats = np.array([1, 1, 1, 2], np.int64)
    constant["repeats"] = onnx.numpy_helper.from_array(repeats, "repeats")
    output = "logits" if "logits" in kind else "probability"
    nodes = {
        "nan": [
            helper.make_node("Mul", ["mean", "minus"], ["negative"]),
            helper.make_node("Sub", ["negative", "five"], ["low"]),
            helper.make_node("Log", ["low"], [output]),
        ],
        "half": [
            helper.make_node("AveragePool", ["mean"], [output], kernel_shape=[2, 2], strides=[2, 2])
        ],
        "five": [helper.make_node("Add", ["mean", "five"], [output])],
        "tile": [
            helper.make_node("Tile", ["mean", "repeats"], ["repeated"]),
            helper.make_node("Identity", ["repeated"], [output]),
        ],
        "the same logits": [
            helper.make_node("Sub", ["mean", "mean"], ["nothing"]),
            helper.make_node("Add", ["nothing", "five"], [output]),
        ],
        # Finite on what a network is tried on, which is never black.
        "nan where it is black": [
            helper.make_node("Div", ["mean", "mean"], ["one"]),
            helper.make_node("Mul", ["one", "mean"], [output]),
        ],
    }
    nodes["logits of nan"] = nodes["nan"]
    graph = helper.make_graph(
        [mean, *nodes[kind]],
        "bad",
        [helper.make_tensor_value_info("image", element, FREE_IMAGE)],
        [helper.make_tensor_value_info(output, element, FREE_MAP)],
        list(constant.values()),
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    path = folder / "bad.onnx"
    onnx.save(model, str(path))
    return path


@needs["onnx"]
@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("nan", "not finite"),
        ("logits of nan", "not finite"),
        ("half", "map of shape (1, 1, 12, 16) for an image that needs (1, 1, 24, 32)"),
        ("tile", "map of shape (1, 1, 24, 64) for an image that needs (1, 1, 24, 32)"),
        ("five", "no probabilities"),
        ("the same logits", "the same value at every pixel"),
    ],
)
def test_a_network_that_answers_wrongly(
    kind: str, words: str, backend: str, tmp_path: Path, one_line: OneLine
) -> None:
    pytest.importorskip(backend)
    with pytest.raises(WeightsError) as caught:
        DeepDetect(bad_answer(tmp_path, kind), backend=backend)
    message = one_line(caught.value)
    assert words in message
    assert "bad.onnx" in message
    assert "use other weights" in message


@needs["onnx"]
@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
def test_a_network_that_answers_wrongly_later(
    backend: str, tmp_path: Path, one_line: OneLine
) -> None:
    pytest.importorskip(backend)
    detector = DeepDetect(bad_answer(tmp_path, "nan where it is black"), backend=backend)
    image = np.random.default_rng(0).integers(1, 256, (48, 64, 3), np.uint8)
    assert detector.heatmap(image).shape == (48, 64)
    image[7, 9] = 0
    for call in (detector.heatmap, detector.detect):
        with pytest.raises(WeightsError) as caught:
            call(image)
        assert "not finite" in one_line(caught.value)
        assert "bad.onnx" in str(caught.value)


@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
def test_damaged_files_print_nothing(
    backend: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip(backend)
    for make in (half(".onnx"), text("words.onnx")):
        with pytest.raises(WeightsError):
            DeepDetect(make(tmp_path), backend=backend)
    content = bytearray(pretrained_weights().read_bytes())
    content[40_000:40_400] = bytes(400)
    (tmp_path / "zeros.onnx").write_bytes(content)
    with contextlib.suppress(WeightsError):
        DeepDetect(tmp_path / "zeros.onnx", backend=backend)
    printed = capfd.readouterr()
    assert printed.out == printed.err == ""


# Too little memory, and memory that grows.

SHORT_OF_MEMORY = """
import resource, sys
import numpy as np
from deepdetect import DeepDetect, DeepDetectError
detector = DeepDetect(backend=sys.argv[1], resolution="native", threads=1)
image = np.random.default_rng(0).integers(0, 256, (1200, 1600, 3), np.uint8)
expected = detector.heatmap(image[:64, :64])
before = resource.getrlimit(resource.RLIMIT_AS)
for megabytes in (10, 40, 80, 150):
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
    done = subprocess.run(
        [sys.executable, "-c", SHORT_OF_MEMORY, backend],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 4
    assert all("not enough memory" in line and "1600x1200" in line for line in lines)


@needs["openvino"]
def test_bfloat16_moves_few_keypoints(image: np.ndarray) -> None:
    openvino = pytest.importorskip("openvino")
    if "BF16" not in openvino.Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES"):
        with pytest.raises(OptionError, match="no instructions for bfloat16"):
            DeepDetect(precision="bfloat16")
        return
    exact, quick = DeepDetect(backend="openvino"), DeepDetect(precision="bfloat16")
    assert (exact.runtime, quick.runtime) == ("openvino", "openvino, bfloat16")
    assert repr(quick).endswith("backend='openvino', precision='bfloat16')")
    assert quick.with_weights("dense").runtime == quick.configured(HeatmapOptions(480)).runtime
    with pytest.raises(OptionError, match="needs the backend openvino, not torch"):
        quick.with_weights(TORCH_WEIGHTS)
    expected, found = exact.heatmap(image), quick.heatmap(image)
    difference = np.abs(found - expected)
    assert 1e-5 < difference.max() < 0.2
    assert ((found > 0.5) != (expected > 0.5)).mean() < 0.01


@pytest.mark.parametrize(
    "heatmap", [np.full((48, 64), np.nan, np.float32), np.zeros((24, 32), np.float32)]
)
def test_a_heat_map_of_somebody_s_own_detector(heatmap: np.ndarray, one_line: OneLine) -> None:
    class Own:
        def heatmap(self, image: Any) -> np.ndarray:
            return heatmap

    image = np.zeros((48, 64, 3), np.uint8)
    with pytest.raises(OptionError) as caught:
        match_images(image, image, Own())
    assert "heat map must be" in one_line(caught.value)


@needs["torch"]
@needs["safetensors"]
def test_logits_are_the_network_s_own(image: np.ndarray) -> None:
    for name in ("default", "dense"):
        torch_maps = DeepDetect(pretrained_weights(name, ".safetensors")).heatmap_and_logits(image)
        onnx_maps = DeepDetect(name, backend="onnxruntime").heatmap_and_logits(image)
        np.testing.assert_allclose(onnx_maps[1], torch_maps[1], atol=2e-3)
        probability = 1 / (1 + np.exp(-onnx_maps[1].astype(np.float64)))
        np.testing.assert_allclose(onnx_maps[0], probability, atol=1e-6)


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


def test_images_are_read_once(photo_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from deepdetect.detector import detector as module
    from deepdetect.matching import pipeline

    read: list[Any] = []

    def counted(source: Any, **options: Any) -> np.ndarray:
        read.append(source)
        return load_image(source, **options)

    monkeypatch.setattr(module, "load_image", counted)
    monkeypatch.setattr(pipeline, "load_image", counted)
    found = match_images(photo_path, photo_path, PointDetector(100))
    assert len(found) == 100
    assert read == [photo_path, photo_path]


@pytest.mark.parametrize("weights", ["default", pretrained_weights("dense")])
def test_a_detector_goes_to_other_processes(weights: Any, image: np.ndarray) -> None:
    detector = DeepDetect(weights, backend="onnxruntime", threads=1, network_channels="bgr")
    other = pickle.loads(pickle.dumps(detector.configured(HeatmapOptions(64, "bgr"))))
    assert other.settings == {**detector.settings, "resolution": 64}
    np.testing.assert_allclose(
        other.heatmap(image), detector.configured(HeatmapOptions(64, "bgr")).heatmap(image)
    )


def test_extracted_keypoints_are_the_detected_ones_described(image: np.ndarray) -> None:
    detector = DeepDetect(backend="onnxruntime")
    found, expected = (call(image, 0.9) for call in (detector.extract, detector.detect))
    np.testing.assert_array_equal(found.xy, expected.xy)
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    np.testing.assert_array_equal(found.descriptors, root_sift_descriptors(gray, found.xy))
    assert found.descriptor_type == found[:3].descriptor_type == "rootsift"
