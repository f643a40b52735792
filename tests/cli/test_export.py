from __future__ import annotations

import json
from pathlib import Path

import pytest

onnx = pytest.importorskip("onnx", reason="needs onnx, which is for exporting only")


from deepdetect.detector.pretrained import pretrained_weights  # noqa: E402


def test_without_points_it_is_the_shipped_file(run, tmp_path: Path) -> None:
    result = run("export", "onnx", "-o", "made.onnx", "--max-keypoints", 0)
    assert result.exit_code == 0, result.output
    model, shipped = onnx.load(tmp_path / "made.onnx"), onnx.load(pretrained_weights())
    assert model.graph == shipped.graph
    assert "MIT" in result.output


def test_size(run, tmp_path: Path) -> None:
    result = run(
        *("export", "onnx", "dense", "-o", "a/made.onnx", "--size", "48x64", "--batch", 2),
        *("--licence", "CC0", "--json"),
    )
    assert result.exit_code == 0, result.output
    summary = json.loads(result.output)
    path = tmp_path / summary["file"]
    assert summary["bytes"] == path.stat().st_size
    wanted = {"size": "48x64", "batch": "2", "licence": "CC0"}
    assert wanted.items() <= summary["metadata"].items()
    sides = onnx.load(path).graph.output[0].type.tensor_type.shape.dim
    assert [side.dim_value for side in sides] == [2, 1, 48, 64]


def test_points(run, tmp_path: Path) -> None:
    result = run("export", "onnx", "-o", "made.onnx", "--max-keypoints", 70, "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.output)["metadata"]["max_keypoints"] == "70"
    outputs = {value.name: value for value in onnx.load(tmp_path / "made.onnx").graph.output}
    assert list(outputs) == ["probability", "logits", "keypoints", "scores", "sizes", "angles"]
    sides = outputs["keypoints"].type.tensor_type.shape.dim
    assert [side.dim_param or side.dim_value for side in sides] == ["batch", 70, 2]


@pytest.mark.parametrize(
    "words",
    [
        "-o a.onnx --batch 2",
        "-o a.onnx --size 480",
        "-o a.onnx --no-maps --max-keypoints 0",
        "-o a.png",
        "text.onnx -o a.onnx",
        "text.onnx -o text.onnx",
    ],
)
def test_a_mistake_leaves_nothing(run, words: str, tmp_path: Path) -> None:
    (tmp_path / "text.onnx").write_text("I am no network")
    assert run("export", "onnx", *words.split()).exit_code == 2
    assert [path.name for path in tmp_path.iterdir()] == ["text.onnx"]
