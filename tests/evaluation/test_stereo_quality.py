from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from deepdetect import LabelOptions, fuse
from deepdetect.cli import main
from deepdetect.datasets.types import StereoPair
from deepdetect.evaluation.stereo_quality import LabelKeypoints, stereo_quality
from deepdetect.io.image import luma


@pytest.fixture
def pair(photo: np.ndarray) -> StereoPair:
    """A photograph and itself, moved by 6 pixels: the truth is exact."""
    left, right = photo[:120, :-6], photo[:120, 6:]
    return StereoPair("moved", left, right, np.full(left.shape[:2], 6.0, np.float32))


def test_labels_are_keypoints(photo: np.ndarray) -> None:
    options = LabelOptions(("fast",))
    heatmap = LabelKeypoints(options).heatmap(photo)
    assert heatmap.dtype == np.float32
    np.testing.assert_array_equal(heatmap > 0.5, fuse(luma(photo), options).mask)


def test_each_source_stands_beside_its_control(pair: StereoPair) -> None:
    steps: list[int] = []
    rows = stereo_quality({"labels": LabelKeypoints()}, [pair, pair], steps.append)
    assert [row.source for row in rows] == [
        *(["labels"] * 2),
        *(["random, as labels"] * 2),
        *(["every pixel"] * 2),
    ]
    assert sum(steps) == len(rows) == 2 * (2 * 1 + 1)
    labels, _, control, _, every, _ = rows
    assert control.density == pytest.approx(labels.density, abs=0.001)
    assert every.density == 1
    assert labels.score.share > 0.9
    assert control.score.share < labels.score.share
    assert labels.score.judged == labels.score.matches
    wrong = StereoPair(pair.name, pair.left, pair.right, pair.disparity + 3)
    found = stereo_quality({"labels": LabelKeypoints()}, [wrong])
    assert found[0].score.share < 0.1
    assert found[0].score.matches == labels.score.matches, "the truth is for judging only"


def test_the_command_prints_a_row_for_each(pair: StereoPair, tmp_path: Path) -> None:
    from click.testing import CliRunner
    from PIL import Image

    for name in ("left", "right"):
        Image.fromarray(getattr(pair, name)).save(tmp_path / f"{name}.png")
    Image.fromarray(np.full(pair.disparity.shape, 24, np.uint8)).save(tmp_path / "disparity.png")
    truth = {"file": "disparity.png", "value_per_pixel": 4, "unknown": 0}
    (tmp_path / "calib.json").write_text(json.dumps({"ground_truth": truth}))
    arguments = [
        "evaluate-stereo",
        str(tmp_path),
        "--label-settings",
        "geometry",
        "--weights",
        "matching",
    ]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    for source in ("labels geometry", "weights matching", "random, as weights", "every pixel"):
        assert source in result.output
    result = CliRunner().invoke(main, [*arguments, "--json"])
    rows = json.loads(result.stdout)
    assert len(rows) == 5
    assert rows[0]["share"] > 0.9
