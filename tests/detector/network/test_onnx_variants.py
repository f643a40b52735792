"""Exported files give what the network gives, in other runtimes, at any size and at one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

onnx = pytest.importorskip("onnx", reason="needs onnx, which is for exporting only")

import cv2  # noqa: E402
import onnxruntime  # noqa: E402

from deepdetect import DeepDetect, OptionError, WeightsError  # noqa: E402
from deepdetect.detector.backends.onnx_parts import cut_onnx  # noqa: E402
from deepdetect.detector.network.onnx_graph import fold_normalisation, read_metadata  # noqa: E402
from deepdetect.detector.network.onnx_variants import OnnxOptions, write_onnx  # noqa: E402
from deepdetect.detector.pretrained import pretrained_weights  # noqa: E402

SIZES = [(64, 96), (123, 157), (17, 23), (80, 41), (200, 16)]
"""Heights and widths: multiples of 8, of 8 in one direction, and of none."""


def images_of(photo: np.ndarray, height: int, width: int, batch: int) -> np.ndarray:
    """Cut (B, 3, H, W) float32 out of a photograph."""
    parts = [photo[9 * k : 9 * k + height, 5 * k : 5 * k + width] for k in range(batch)]
    return np.ascontiguousarray(np.stack(parts).transpose(0, 3, 1, 2) * np.float32(1 / 255))


def session_of(model: Path | bytes) -> onnxruntime.InferenceSession:
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads, settings.log_severity_level = 1, 4
    given = model if isinstance(model, bytes) else str(model)
    return onnxruntime.InferenceSession(given, settings, providers=["CPUExecutionProvider"])


@pytest.fixture(scope="module")
def network() -> onnxruntime.InferenceSession:
    """The network alone, without padding, of the shipped file."""
    shipped = pretrained_weights().read_bytes()
    return session_of(cut_onnx(shipped, ["padded_image"], ["padded_logits"]))


def expected_logits(network: onnxruntime.InferenceSession, images: np.ndarray) -> np.ndarray:
    height, width = images.shape[2:]
    sides = ((0, 0), (0, 0), (0, -height % 8), (0, -width % 8))
    padded = np.pad(images, sides, mode="edge")
    return network.run(None, {"padded_image": padded})[0][:, :, :height, :width]


def check_answers(logits: np.ndarray, probability: np.ndarray, expected: np.ndarray) -> None:
    assert logits.shape == probability.shape == expected.shape
    assert logits.dtype == probability.dtype == np.float32
    np.testing.assert_allclose(logits, expected, atol=1e-3)
    exact = 1 / (1 + np.exp(-expected.astype(np.float64)))
    np.testing.assert_allclose(probability, exact, atol=2e-4)
    assert probability.min() >= 0
    assert probability.max() <= 1


@pytest.mark.parametrize("batch", [1, 2])
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_onnxruntime(
    height: int, width: int, batch: int, photo: np.ndarray, network: onnxruntime.InferenceSession
) -> None:
    images = images_of(photo, height, width, batch)
    logits, probability = session_of(pretrained_weights()).run(
        ["logits", "probability"], {"image": images}
    )
    check_answers(logits, probability, expected_logits(network, images))


def test_the_probability_is_never_over_one() -> None:
    """Without the limit it is 1.0000001 at some of these."""
    shipped = pretrained_weights().read_bytes()
    given = np.linspace(-120, 120, 100_000, dtype=np.float32).reshape(1, 1, 100, -1)
    found = session_of(cut_onnx(shipped, ["logits"], ["probability"])).run(None, {"logits": given})
    assert found[0].max() == 1
    raw = session_of(cut_onnx(shipped, ["logits"], ["sigmoid"])).run(None, {"logits": given})
    np.testing.assert_array_equal(np.minimum(raw[0], 1), found[0])


@pytest.mark.parametrize("batch", [1, 2])
def test_openvino(batch: int, photo: np.ndarray, network: onnxruntime.InferenceSession) -> None:
    openvino = pytest.importorskip("openvino", reason="needs OpenVINO")
    settings = {"INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": 1}
    model = openvino.Core().compile_model(str(pretrained_weights()), "CPU", settings)
    for height, width in SIZES:
        images = images_of(photo, height, width, batch)
        found = model([images])
        check_answers(found["logits"], found["probability"], expected_logits(network, images))


@pytest.mark.skipif(cv2.__version__ < "5", reason="needs the new engine of OpenCV 5")
@pytest.mark.parametrize("batch", [1, 2])
def test_opencv_5_at_any_size(
    batch: int, photo: np.ndarray, network: onnxruntime.InferenceSession
) -> None:
    model = cv2.dnn.readNetFromONNX(str(pretrained_weights()), cv2.dnn.ENGINE_NEW)
    for height, width in SIZES:
        images = images_of(photo, height, width, batch)
        model.setInput(images)
        # A list must name all outputs.
        logits, probability, *_ = model.forward(
            ["logits", "probability", "keypoints", "keypoint_logits"]
        )
        check_answers(logits, probability, expected_logits(network, images))


@pytest.mark.skipif(cv2.__version__ < "5", reason="its message is of OpenCV 5")
def test_the_classic_engine_refuses_the_file_for_any_size() -> None:
    with pytest.raises(cv2.error, match="Shape"):
        cv2.dnn.readNetFromONNX(str(pretrained_weights()), cv2.dnn.ENGINE_CLASSIC)


NAMES = ["ENGINE_CLASSIC", "ENGINE_NEW"] if cv2.__version__ >= "5" else []
ENGINES = [[getattr(cv2.dnn, name)] for name in NAMES] or [[]]
"""OpenCV 4 has one engine, the classic one of OpenCV 5."""


@pytest.mark.parametrize("batch", [1, 2])
@pytest.mark.parametrize("size", SIZES)
def test_opencv_at_one_size(
    size: tuple[int, int],
    batch: int,
    tmp_path: Path,
    photo: np.ndarray,
    network: onnxruntime.InferenceSession,
) -> None:
    path = tmp_path / "one.onnx"
    write_onnx("default", path, OnnxOptions(size, batch))
    model = onnx.load(path)
    onnx.checker.check_model(model, full_check=True)
    assert "Shape" not in {node.op_type for node in model.graph.node}
    images = images_of(photo, *size, batch)
    for engine in ENGINES:
        net = cv2.dnn.readNetFromONNX(str(path), *engine)
        net.setInput(images)
        check_answers(*net.forward(["logits", "probability"]), expected_logits(network, images))


@pytest.mark.parametrize("name", ["default", "dense", "free"])
def test_the_shipped_files_are_those_of_the_safetensors(name: str, tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="needs torch, which is for training only")
    shipped = pretrained_weights(name)
    write_onnx(shipped.with_suffix(".safetensors"), tmp_path / "made.onnx")
    made, model = onnx.load(tmp_path / "made.onnx"), onnx.load(shipped)
    assert made.graph == model.graph
    metadata = read_metadata(model)
    assert (metadata["weights"], metadata["licence"]) == (name, "MIT")
    assert {**read_metadata(made), "weights": name, "licence": "MIT"} == {
        **metadata,
        "version": read_metadata(made)["version"],
    }


@pytest.mark.parametrize("name", ["default", "dense", "free"])
def test_batch_normalisation_is_folded(name: str) -> None:
    graph = onnx.load(pretrained_weights(name)).graph
    assert "BatchNormalization" not in {node.op_type for node in graph.node}


@pytest.mark.parametrize("name", ["default", "dense", "free"])
def test_numbers_for_each_channel_have_four_dimensions(name: str) -> None:
    graph = onnx.load(pretrained_weights(name)).graph
    dimensions = {one.name: list(one.dims) for one in graph.initializer}
    shapes = [
        dimensions[each]
        for node in graph.node
        if node.op_type in ("Add", "Mul", "PRelu")
        for each in node.input
        if each in dimensions
    ]
    assert not [each for each in shapes if len(each) == 3]
    assert sum(len(each) == 4 and each[1] > 1 for each in shapes) > 20


def test_a_file_of_version_0_2_gets_them(tmp_path: Path) -> None:
    """Exported again, it is the shipped file of today."""
    model = onnx.load(pretrained_weights())
    for one in model.graph.initializer:
        if len(one.dims) == 4 and list(one.dims[:1] + one.dims[2:]) == [1, 1, 1]:
            del one.dims[0]
    onnx.save(model, tmp_path / "older.onnx")
    write_onnx(tmp_path / "older.onnx", tmp_path / "again.onnx")
    shipped = onnx.load(pretrained_weights()).graph
    assert model.graph != shipped
    assert onnx.load(tmp_path / "again.onnx").graph == shipped


def normalised_network(nodes: list[onnx.NodeProto], outputs: list[str]) -> onnx.ModelProto:
    """A network of these nodes, which read `image`, `kernel`, `offset` and the statistics."""
    rng = np.random.default_rng(0)
    arrays = {"kernel": rng.normal(size=(3, 3, 2, 2)), "offset": rng.normal(size=3)}
    arrays |= dict(zip(STATISTICS, rng.uniform(0.5, 2, (4, 3)), strict=True))
    used = {name for node in nodes for name in node.input}
    graph = onnx.helper.make_graph(
        nodes,
        "one",
        [onnx.helper.make_tensor_value_info("image", 1, ("b", 3, "h", "w"))],
        [onnx.helper.make_tensor_value_info(name, 1, ("b", 3, None, None)) for name in outputs],
        [
            onnx.numpy_helper.from_array(array.astype(np.float32), name)
            for name, array in arrays.items()
            if name in used
        ],
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)])
    model.ir_version = 8
    return model


STATISTICS = ["weight", "bias", "mean", "variance"]


def convolution(made: str, *more: str, kind: str = "Conv") -> onnx.NodeProto:
    return onnx.helper.make_node(kind, ["image", "kernel", *more], [made], strides=[2, 2])


def normalisation(read: str, made: str) -> onnx.NodeProto:
    return onnx.helper.make_node("BatchNormalization", [read, *STATISTICS], [made], epsilon=0.25)


def node(kind: str, *names: str) -> onnx.NodeProto:
    return onnx.helper.make_node(kind, list(names[:-1]), [names[-1]])


def check_that_folding_changes_no_answer(model: onnx.ModelProto, photo: np.ndarray) -> None:
    images = {"image": images_of(photo, 6, 8, 2)}
    expected = session_of(model.SerializeToString()).run(None, images)
    fold_normalisation(model.graph)
    onnx.checker.check_model(model, full_check=True)
    assert "BatchNormalization" not in {one.op_type for one in model.graph.node}
    for array, other in zip(
        session_of(model.SerializeToString()).run(None, images), expected, strict=True
    ):
        np.testing.assert_allclose(array, other, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("last", [True, False])
@pytest.mark.parametrize("kind", ["Conv", "ConvTranspose"])
def test_batch_normalisation_is_folded_into_a_convolution(
    kind: str, last: bool, photo: np.ndarray
) -> None:
    """In float64: the kernel is the exact one, rounded once."""
    behind = [] if last else [node("Neg", "normalised", "logits")]
    nodes = [convolution("made", kind=kind), normalisation("made", "normalised"), *behind]
    model = normalised_network(nodes, ["normalised" if last else "logits"])
    before = {one.name: onnx.numpy_helper.to_array(one) for one in model.graph.initializer}
    check_that_folding_changes_no_answer(model, photo)
    found = list(model.graph.node)
    assert [one.op_type for one in found] == [kind, *(one.op_type for one in behind)]
    # Its output keeps its name, by which `tiling` knows it, unless the network ends there.
    assert list(found[0].output) == ["normalised" if last else "made"]
    weight, bias, mean, variance = (before[name].astype(np.float64) for name in STATISTICS)
    factor = weight / np.sqrt(variance + 0.25)
    folded = {one.name: onnx.numpy_helper.to_array(one) for one in model.graph.initializer}
    axes = (slice(None), *[None] * 3) if kind == "Conv" else (None, slice(None), None, None)
    exact = before["kernel"] * factor[axes]
    np.testing.assert_array_equal(folded["kernel.folded"], exact.astype(np.float32))
    exact = bias - mean * factor
    np.testing.assert_array_equal(folded["kernel.bias"], exact.astype(np.float32))


@pytest.mark.parametrize(
    ("nodes", "outputs"),
    [
        (
            [
                convolution("one"),
                normalisation("one", "first"),
                node("Neg", "image", "other"),
                onnx.helper.make_node("Conv", ["other", "kernel"], ["two"], strides=[2, 2]),
                normalisation("two", "second"),
            ],
            ["first", "second"],
        ),
        (
            [
                convolution("made"),
                normalisation("made", "normalised"),
                node("Add", "made", "normalised", "logits"),
            ],
            ["logits"],
        ),
        (
            [
                convolution("made"),
                normalisation("made", "normalised"),
                node("Neg", "made", "other"),
                normalisation("other", "second"),
            ],
            ["normalised", "second"],
        ),
        (
            [
                convolution("made"),
                normalisation("made", "first"),
                normalisation("made", "second"),
                node("Mul", "first", "second", "logits"),
            ],
            ["logits"],
        ),
        ([convolution("made"), normalisation("made", "normalised")], ["made", "normalised"]),
        ([convolution("made", "offset"), normalisation("made", "normalised")], ["normalised"]),
    ],
    ids=[
        "same kernel",
        "read twice",
        "read twice, apart",
        "two of one",
        "an output",
        "with a bias",
    ],
)
def test_batch_normalisation_that_does_not_fit_a_convolution(
    nodes: list[onnx.NodeProto], outputs: list[str], photo: np.ndarray
) -> None:
    model = normalised_network(nodes, outputs)
    check_that_folding_changes_no_answer(model, photo)
    assert {"Conv", "Mul", "Add"} <= {one.op_type for one in model.graph.node}


def test_batch_normalisation_of_an_older_file_is_folded(tmp_path: Path, photo: np.ndarray) -> None:
    """Behind a sum: (x + x) normalised per channel, beside NumPy."""
    rng = np.random.default_rng(0)
    weight, bias, mean, variance = rng.uniform(0.5, 2, (4, 3)).astype(np.float32)
    graph = onnx.helper.make_graph(
        [
            onnx.helper.make_node("Add", ["image", "image"], ["sum"]),
            onnx.helper.make_node("Identity", ["weight"], ["same"]),
            onnx.helper.make_node(
                "BatchNormalization",
                ["sum", "same", "bias", "mean", "variance"],
                ["logits"],
                epsilon=0.25,
            ),
        ],
        "older",
        [onnx.helper.make_tensor_value_info("image", 1, ("b", 3, "h", "w"))],
        [onnx.helper.make_tensor_value_info("logits", 1, ("b", 3, "h", "w"))],
        [
            onnx.numpy_helper.from_array(array, name)
            for name, array in (
                ("weight", weight),
                ("bias", bias),
                ("mean", mean),
                ("variance", variance),
            )
        ],
    )
    fold_normalisation(graph)
    assert [node.op_type for node in graph.node if node.op_type != "Identity"] == [
        "Add",
        "Mul",
        "Add",
    ]
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)])
    model.ir_version = 8
    images = images_of(photo, 5, 7, 2)
    (found,) = session_of(model.SerializeToString()).run(None, {"image": images})
    scale, offset, middle, spread = (
        array[:, None, None] for array in (weight, bias, mean, variance)
    )
    expected = (2 * images - middle) / np.sqrt(spread + 0.25) * scale + offset
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_metadata(tmp_path: Path) -> None:
    found = write_onnx(
        "default", tmp_path / "one.onnx", OnnxOptions((48, 64), precision="fp16"), licence="CC0"
    )
    read = session_of(tmp_path / "one.onnx").get_modelmeta().custom_metadata_map
    assert read == found
    assert {name: read[name] for name in ("channels", "range", "stride", "licence", "size")} == {
        "channels": "RGB",
        "range": "0 to 1",
        "stride": "8",
        "licence": "CC0",
        "size": "48x64",
    }
    assert read["precision"] == "fp16"


@pytest.mark.parametrize("options", [OnnxOptions(), OnnxOptions((123, 157)), OnnxOptions((64, 96))])
def test_half_precision(
    options: OnnxOptions,
    tmp_path: Path,
    photo: np.ndarray,
    network: onnxruntime.InferenceSession,
) -> None:
    path = tmp_path / "half.onnx"
    write_onnx("default", path, OnnxOptions(options.size, precision="fp16"))
    assert path.stat().st_size < 0.55 * pretrained_weights().stat().st_size
    onnx.checker.check_model(onnx.load(path), full_check=True)
    images = images_of(photo, *(options.size or (77, 90)), 1)
    logits = session_of(path).run(["logits"], {"image": images})[0]
    expected = expected_logits(network, images)
    assert logits.dtype == np.float32
    assert 0 < np.abs(logits - expected).max() < 0.5
    assert np.mean((logits > 0) == (expected > 0)) > 0.998


@pytest.mark.slow
def test_eight_bits(
    tmp_path: Path, photo: np.ndarray, network: onnxruntime.InferenceSession
) -> None:
    from PIL import Image

    for k in range(3):
        Image.fromarray(photo[20 * k : 20 * k + 150, 30 * k : 30 * k + 180]).save(
            tmp_path / f"{k}.png"
        )
    paths = sorted(tmp_path.glob("*.png"))
    path = tmp_path / "small.onnx"
    write_onnx("default", path, OnnxOptions(precision="int8"), calibration=paths)
    assert path.stat().st_size < 0.5 * pretrained_weights().stat().st_size
    onnx.checker.check_model(onnx.load(path), full_check=True)
    images = images_of(photo, 123, 157, 2)
    logits = session_of(path).run(["logits"], {"image": images})[0]
    expected = expected_logits(network, images)
    assert np.mean((logits > 0) == (expected > 0)) > 0.97
    # The package's own backend takes it, too.
    assert DeepDetect(path, backend="onnxruntime").heatmap(photo).shape == photo.shape[:2]


def test_an_older_file_is_padded(tmp_path: Path, photo: np.ndarray) -> None:
    """Files of trainings before the padding map multiples of 8, and say nothing of themselves."""
    model = onnx.load_model_from_string(
        cut_onnx(pretrained_weights().read_bytes(), ["padded_image"], ["padded_logits"])
    )
    for value, name in ((model.graph.input[0], "image"), (model.graph.output[0], "logits")):
        old, value.name = value.name, name
        for node in model.graph.node:
            for names in (node.input, node.output):
                names[:] = [name if each == old else each for each in names]
    probability = onnx.helper.make_tensor_value_info("probability", 1, ("b", 1, "h", "w"))
    model.graph.output.insert(0, probability)
    model.graph.node.append(onnx.helper.make_node("Sigmoid", ["logits"], ["probability"]))
    del model.metadata_props[:]
    onnx.save(model, str(tmp_path / "old.onnx"))
    metadata = write_onnx(tmp_path / "old.onnx", tmp_path / "new.onnx")
    assert metadata["weights"] == "old.onnx"
    assert "licence" not in metadata
    images = images_of(photo, 45, 50, 1)
    found, expected = (
        session_of(path).run(["logits"], {"image": images})[0]
        for path in (tmp_path / "new.onnx", pretrained_weights())
    )
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"precision": "fp8"}, "did you mean 'fp"),
        ({"batch": 2}, "`batch` needs `size`"),
        ({"size": (4, 64)}, "`size` must lie in"),
        ({"size": (64,)}, "height and width"),
        ({"size": (64, 64), "batch": 0}, "`batch` must lie in"),
        ({"max_calibration_images": 0}, "`max_calibration_images` must lie in"),
    ],
)
def test_options_are_checked(values: dict[str, object], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        OnnxOptions(**values)


def test_a_changed_file_is_not_changed_again(tmp_path: Path) -> None:
    write_onnx("default", tmp_path / "half.onnx", OnnxOptions(precision="fp16"))
    with pytest.raises(WeightsError, match="precision fp16: give the file that it was made from"):
        write_onnx(tmp_path / "half.onnx", tmp_path / "again.onnx")
    assert not (tmp_path / "again.onnx").exists()


@pytest.mark.parametrize(
    ("options", "calibration", "message"),
    [
        (OnnxOptions(precision="int8"), [], "give `calibration`"),
        (OnnxOptions(), [Path("a.png")], "is for int8, not fp32"),
    ],
)
def test_calibration_is_for_eight_bits(
    options: OnnxOptions, calibration: list[Path], message: str, tmp_path: Path
) -> None:
    with pytest.raises(OptionError, match=message):
        write_onnx("default", tmp_path / "a.onnx", options, calibration=calibration)
    assert not list(tmp_path.iterdir())
