from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from deepdetect import DeepDetect, OptionError
from deepdetect.detector.heatmap import HeatmapOptions
from deepdetect.geometry.transforms import transfer_errors
from deepdetect.io.image import luma
from deepdetect_lab.datasets.planar import OXFORD_KINDS, load_oxford
from deepdetect_lab.evaluation.baselines.method import deepdetect_feature
from deepdetect_lab.evaluation.masks import LabelDetector, evaluate
from deepdetect_lab.evaluation.options import PAPER_RESOLUTION_PX, THRESHOLDS
from deepdetect_lab.evaluation.protocols.paper import correct_matches
from deepdetect_lab.evaluation.run import Run
from deepdetect_lab.evaluation.unguided import match_unguided
from deepdetect_lab.labels import fuse

SIZE = 96


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight scenes of small crops, each image shifted by whole pixels against the first."""
    from skimage import data

    root = tmp_path_factory.mktemp("oxford")
    image = cv2.resize(data.astronaut(), (384, 384), interpolation=cv2.INTER_AREA)
    for index, scene in enumerate(OXFORD_KINDS):
        (root / scene).mkdir()
        for number in range(1, 7):
            left, top = 8 * index + 2 * (number - 1), 40 + number - 1
            crop = np.ascontiguousarray(image[top : top + SIZE, left : left + SIZE])
            Image.fromarray(crop).save(root / scene / f"img{number}.png")
            if number > 1:
                shift = f"1 0 {-2 * (number - 1)} 0 1 {-(number - 1)} 0 0 1"
                (root / scene / f"H1to{number}p").write_text(shift)
    return root


@pytest.mark.slow
def test_the_pretrained_weights_are_as_dense_as_the_paper_s(
    shared: Path, published: Callable[[str], Path]
) -> None:
    """All 48 images of Oxford: within 0.04 at each threshold."""
    squashing = [
        detector.configured(HeatmapOptions(480))
        for detector in (DeepDetect(), DeepDetect(published("matching")))
    ]
    images = [path for scene in load_oxford(shared / "data" / "oxford") for path in scene.images]
    maps = [[detector.heatmap(path) for path in images] for detector in squashing]
    ours, theirs = (
        [np.mean([(heatmap > threshold).mean() for heatmap in own]) for threshold in THRESHOLDS]
        for own in maps
    )
    assert ours == sorted(ours, reverse=True)
    np.testing.assert_allclose(ours, theirs, atol=0.04)


def test_counts_are_those_of_the_published_matching(folder: Path) -> None:
    pair = load_oxford(folder)[0].pairs[0]
    labels = LabelDetector(heatmap_options=HeatmapOptions(PAPER_RESOLUTION_PX))
    feature = deepdetect_feature(labels, version="1")
    found = match_unguided(pair.first, pair.second, labels)
    errors = transfer_errors(found.points0, found.points1, pair.homography)
    assert len(found) > 0
    assert correct_matches(Run(folder), feature, pair) == ((errors < 1).sum(), len(found))


def test_samples_and_their_scales(tmp_path: Path, photo: np.ndarray) -> None:
    Image.fromarray(photo).save(tmp_path / "image_1.png")
    Image.fromarray(fuse(luma(photo)).mask).save(tmp_path / "mask_image_1.png")
    found = evaluate(tmp_path, scales=(1, 0.5))
    assert list(found.scales) == [(1, "normal"), (0.5, "normal")]
    assert found.masks == {"normal": found.scales[1, "normal"]}


@pytest.mark.parametrize("options", [{"scale": (0.5,)}, {"scales": (1, math.nan)}])
def test_wrong_options_are_said(options: dict) -> None:
    with pytest.raises(OptionError):
        evaluate("x", **options)


def test_samples_that_cannot_be_read_are_listed_and_not_scored(
    tmp_path: Path, photo: np.ndarray
) -> None:
    from tests.command_line import run_command

    for name in "abc":
        Image.fromarray(photo[:64, :64]).save(tmp_path / f"image_{name}.png")
        Image.fromarray(photo[:64, :64, 0] > 99).save(tmp_path / f"mask_image_{name}.png")
    whole = evaluate(tmp_path)
    assert whole.failures == ()
    (tmp_path / "image_a.png").write_bytes(b"damaged")
    (tmp_path / "mask_image_b.png").unlink()
    found = evaluate(tmp_path)
    assert [score.images for score in found.masks.values()] == [1]
    assert found.masks["normal"].loss == pytest.approx(whole.masks["normal"].loss)
    assert len(found.failures) == 2
    result = run_command(["dev", "evaluate", str(tmp_path)])
    assert result.exit_code == 1
    assert "normal" in result.stdout
    first, second = result.stderr.splitlines()[-2:]
    assert "image_a.png" in first
    assert "mask_image_b.png" in second
    (tmp_path / "image_c.png").unlink()
    assert run_command(["dev", "evaluate", str(tmp_path)]).exit_code == 2


def test_probabilities_are_calibrated_against_masks_and_labels(tmp_path: Path, photo) -> None:

    from tests.command_line import run_command

    Image.fromarray(photo).save(tmp_path / "a.png")
    found = evaluate(tmp_path, scales=[0.5])
    assert found.masks == {}
    (score,) = found.scales.values()
    assert 0 < score.calibration_error < 0.2
    result = run_command(["dev", "evaluate", str(tmp_path), "--scale", "0.5", "--json"])
    (told,) = json.loads(result.stdout)["scales"]
    assert told["calibration_error"] == score.calibration_error
    assert told["label_density"] == score.label_density
    assert run_command(["dev", "evaluate", str(tmp_path)]).exit_code == 2


def test_images_too_small_for_a_scale_do_not_end_the_measurement(
    tmp_path: Path, photo: np.ndarray
) -> None:
    for name, side in (("a", 24), ("b", 96), ("c", 30)):
        Image.fromarray(photo[:side, :96]).save(tmp_path / f"{name}.png")
    found = evaluate(tmp_path, scales=(0.5, 1))
    images = {scale: score.images for (scale, _), score in found.scales.items()}
    assert images == {0.5: 1, 1: 3}
    assert len(found.failures) == 2
    for name, failure in zip("ac", found.failures, strict=True):
        assert f"{name}.png" in failure
