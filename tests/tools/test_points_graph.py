"""The graph of the points does what the package does, in any runtime."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

onnx = pytest.importorskip("onnx", reason="needs onnx, which is for exporting only")

import onnxruntime  # noqa: E402

from deepdetect.detector.points.detection import detect_points, least_distances  # noqa: E402
from deepdetect.detector.points.hessian_scales import SIGMAS_PX  # noqa: E402
from deepdetect.detector.pretrained import POINTS_GRAPH  # noqa: E402
from deepdetect.features.selection import suppress_neighbors  # noqa: E402
from deepdetect.io.image import luma  # noqa: E402


@pytest.fixture(scope="module")
def script() -> Any:
    path = Path(__file__).parents[2] / "tools/points_graph.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


def run(model: Any, **given: np.ndarray) -> list[np.ndarray]:
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads, settings.log_severity_level = 1, 4
    session = onnxruntime.InferenceSession(model.SerializeToString(), settings)
    return session.run(None, given)


def test_the_file_of_the_package_is_made_by_the_script(script: Any) -> None:
    made, shipped = script.points_model(), onnx.load(POINTS_GRAPH)
    onnx.checker.check_model(shipped, full_check=True)
    assert made == shipped, "run python tools/points_graph.py"


def test_gray_is_that_of_opencv(script: Any) -> None:
    graph = script.Graph("")
    gray = script.gray_of(script.Tensor(graph, "image"))
    given = "image", script.FLOAT, [1, 3, 512, 512]
    model = graph.model([given], [("gray", script.FLOAT, None)], [gray])
    rgb = np.random.default_rng(0).integers(0, 256, (512, 512, 3), np.uint8)
    rgb[:4, :64] = np.arange(256).reshape(4, 64, 1)
    image = np.ascontiguousarray(rgb.transpose(2, 0, 1)[None] / np.float32(255))
    np.testing.assert_array_equal(run(model, image=image)[0][0, 0], luma(rgb))


def test_candidates_of_the_page_are_all_those_of_the_package(
    script: Any, photo: np.ndarray
) -> None:
    gray = luma(np.ascontiguousarray(photo[:150, :200]))
    x, y, sigmas, logits = (
        each[0]
        for each in run(script.candidates_model(), gray=gray[None, None], limit=np.array([10**6]))
    )
    found = np.flatnonzero(np.isfinite(logits))
    np.testing.assert_array_equal(found, np.arange(len(found)))  # none behind the last
    assert len(found) < len(logits)
    xy, radii = np.column_stack([x, y])[found], least_distances(sigmas[found])
    kept = suppress_neighbors(xy, logits[found], radii)
    expected = detect_points(gray)
    assert abs(len(kept) - len(expected)) <= 2
    gaps = np.linalg.norm(xy[kept][:, None] - expected.xy, axis=2)
    assert (gaps.min(0) < 0.05).mean() > 0.99
    few = run(script.candidates_model(), gray=gray[None, None], limit=np.array([300]))
    assert np.isfinite(few[3]).sum() == 300 < len(found)
    np.testing.assert_array_equal(few[3][0, :300], logits[:300])


def test_suppression_is_greedy_at_any_density(script: Any) -> None:
    """Also where each point has many neighbours, and one after the other depends on the last."""
    generator = np.random.default_rng(0)
    graph = script.Graph("")
    given = {"x": 1, "y": 1, "level": 7, "logits": 1}
    outputs = script.choose(*(script.Tensor(graph, name) for name in given), graph.constant([900]))[
        :4
    ]
    model = graph.model(
        [("x", 1, ["batch", "count"])],
        [(f"kept_{name}", 1, None) for name in ("x", "y", "scores", "sizes")],
        outputs,
    )
    for name, kind in list(given.items())[1:]:
        shape = ["batch", "count"]
        model.graph.input.append(onnx.helper.make_tensor_value_info(name, kind, shape))
    count = 2 * script.CHUNK
    xy = generator.uniform(0, (90, 60), (2, count, 2)).astype(np.float32)
    xy[1] = np.arange(count)[:, None] * np.float32(0.75)  # a line: every third one is kept
    logits = np.sort(generator.normal(size=(2, count)).astype(np.float32))[:, ::-1].copy()
    logits[0, 3000:] = -np.inf
    level = generator.integers(1, 8, (2, count))
    level[1] = 1
    x, y, scores, sizes = run(model, x=xy[..., 0], y=xy[..., 1], level=level, logits=logits)
    for k, valid in enumerate((3000, count)):
        sigmas = SIGMAS_PX[level[k, :valid]]
        kept = suppress_neighbors(xy[k, :valid], logits[k, :valid], least_distances(sigmas), 900)
        n = len(kept)
        assert n == 900 if k else 300 < n < 900
        np.testing.assert_array_equal(np.column_stack([x[k, :n], y[k, :n]]), xy[k, kept])
        np.testing.assert_allclose(sizes[k, :n], 2.5 * sigmas[kept], rtol=1e-6)
        assert (np.diff(scores[k]) <= 0).all()
        assert (scores[k, n:] == 0).all()
        assert (x[k, n:] == -1).all()
