from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from deepdetect import DeepDetect, ImageError, OptionError
from deepdetect.detector.heatmap import HeatmapOptions
from deepdetect.geometry.transforms import transfer_errors
from deepdetect.io.image import luma
from deepdetect_lab.datasets.planar import OXFORD_KINDS, load_oxford
from deepdetect_lab.evaluation.baselines.method import deepdetect_feature
from deepdetect_lab.evaluation.options import PAPER_RESOLUTION_PX, THRESHOLDS
from deepdetect_lab.evaluation.protocols import paper
from deepdetect_lab.evaluation.protocols.masks import (
    LabelDetector,
)
from deepdetect_lab.evaluation.protocols.paper import OXFORD_PAIRS, mean_correct_matches
from deepdetect_lab.evaluation.run import Run
from deepdetect_lab.evaluation.unguided import match_unguided
from deepdetect_lab.evaluation.weights import evaluate, evaluate_oxford
from deepdetect_lab.labels import fuse

SIZE = 96


@pytest.fixture
def quick_protocol(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small images are not enlarged to 480x480, nor are few matches counted 64 times."""
    monkeypatch.setattr(paper, "MANY_SEEDS", 1)
    for module in ("weights", "options"):
        monkeypatch.setattr(f"deepdetect_lab.evaluation.{module}.PAPER_RESOLUTION_PX", SIZE)


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
@pytest.mark.usefixtures("quick_protocol")
def test_shifted_images_repeat_and_match(folder: Path) -> None:
    found = evaluate_oxford(DeepDetect(), load_oxford(folder))
    densities = [found.density[threshold] for threshold in THRESHOLDS]
    assert densities == sorted(densities, reverse=True)
    assert 0.1 < densities[0] < 0.9
    assert set(found.repeatability) == set(OXFORD_KINDS)
    assert min(found.repeatability.values()) > 0.7
    assert set(found.correct) == {f"{scene} 1-{number}" for scene, number in OXFORD_PAIRS}
    for pair, correct in found.correct.items():
        assert 0.4 * found.matches[pair] < correct <= found.matches[pair]


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


@pytest.mark.slow
@pytest.mark.usefixtures("quick_protocol")
def test_at_equal_density_weights_have_as_many_keypoints_as_the_labels(
    run_evaluate, folder: Path
) -> None:
    arguments = ("--oxford", folder, "--compare", "dense", "--equal-density", "--json")
    report = json.loads(run_evaluate(*arguments))
    squashed = LabelDetector(heatmap_options=HeatmapOptions(SIZE))
    labels = evaluate_oxford(squashed, load_oxford(folder)).density[0.5]
    of_all = [*report["oxford"]["density"].values()]
    of_all += report["compare"][0]["oxford"]["density"].values()
    densities = {round(density, 4) for density in (labels, *of_all)}
    assert len(densities) == 1
    at_half = evaluate_oxford(DeepDetect(), load_oxford(folder)).density[0.5]
    assert abs(at_half - densities.pop()) > 1e-3, "0.5 gives another number"


def test_the_foreground_is_measured(run_evaluate, tmp_path: Path) -> None:
    from skimage import data

    photographs = tmp_path / "photographs"
    photographs.mkdir()
    image = cv2.resize(data.astronaut(), (128, 96), interpolation=cv2.INTER_AREA)
    left = np.zeros((96, 128), bool)
    left[:, :64] = True
    for name, mask in (("left", left), ("right", ~left)):
        Image.fromarray(image).save(photographs / f"{name}.png")
        Image.fromarray(mask).save(photographs / f"{name}_mask.png")
    score = evaluate(foreground=photographs).foreground
    assert score is not None
    assert score.photographs == 2
    assert (score.fraction, score.covered) == (pytest.approx(0.5), 0.5), "of two halves, the mean"
    label = LabelDetector(heatmap_options=HeatmapOptions(PAPER_RESOLUTION_PX)).heatmap(image) > 0.5
    equal = evaluate(foreground=photographs, equal_density=True).foreground
    assert equal is not None
    assert equal.density == label.mean() != score.density
    text = run_evaluate("--foreground", photographs)
    line = next(line for line in text.splitlines() if "foreground: fraction" in line)
    assert float(line.split()[-1]) == pytest.approx(0.5)


def test_counts_are_those_of_the_published_matching(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(paper, "MANY_SEEDS", 2)
    pair = load_oxford(folder)[0].pairs[0]
    labels = LabelDetector(heatmap_options=HeatmapOptions(PAPER_RESOLUTION_PX))
    feature = deepdetect_feature(labels, version="1")
    counts = []
    for seed in range(2):
        found = match_unguided(pair.first, pair.second, labels, seed=seed)
        errors = transfer_errors(found.points0, found.points1, pair.homography)
        counts.append([np.count_nonzero(errors < 1), len(found)])
    expected = np.rint(np.mean(counts, axis=0)).astype(int).tolist()
    assert expected[1] > 0
    assert list(mean_correct_matches(Run(folder), feature, pair)) == expected


def test_samples_and_their_scales(tmp_path: Path, photo: np.ndarray) -> None:
    Image.fromarray(photo).save(tmp_path / "image_1.png")
    Image.fromarray(fuse(luma(photo)).mask).save(tmp_path / "mask_image_1.png")
    found = evaluate(samples=tmp_path, scales=(1, 0.5))
    assert found.oxford is None
    assert list(found.scales) == [(1, "normal"), (0.5, "normal")]
    assert found.masks == {"normal": found.scales[1, "normal"]}
    assert evaluate().masks == {}


@pytest.mark.parametrize(
    "options", [{"scales": (0.5,)}, {"sample": "x"}, {"samples": "x", "scales": (1, math.nan)}]
)
def test_wrong_options_are_said(options: dict) -> None:
    with pytest.raises(OptionError):
        evaluate(**options)


def test_samples_that_cannot_be_read_are_listed_and_not_scored(
    tmp_path: Path, photo: np.ndarray
) -> None:
    from tests.command_line import run_command

    for name in "abc":
        Image.fromarray(photo[:64, :64]).save(tmp_path / f"image_{name}.png")
        Image.fromarray(photo[:64, :64, 0] > 99).save(tmp_path / f"mask_image_{name}.png")
    whole = evaluate(samples=tmp_path)
    assert whole.failures == ()
    (tmp_path / "image_a.png").write_bytes(b"damaged")
    (tmp_path / "mask_image_b.png").unlink()
    found = evaluate(samples=tmp_path)
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


def test_damaged_photographs_do_not_end_the_measurement_of_the_others(
    run_evaluate, tmp_path: Path
) -> None:
    from skimage import data
    from tests.command_line import run_command

    photographs = tmp_path / "photographs"
    photographs.mkdir()
    image = cv2.resize(data.astronaut(), (128, 96), interpolation=cv2.INTER_AREA)
    for name in ("a", "b", "c"):
        Image.fromarray(image).save(photographs / f"{name}.png")
        Image.fromarray(image[..., 0] > 99).save(photographs / f"{name}_mask.png")
    whole = evaluate(foreground=photographs).foreground
    assert whole is not None
    assert whole.failures == ()
    (photographs / "a.png").write_bytes(b"damaged")
    Image.fromarray(image[:50, :, 0] > 99).save(photographs / "b_mask.png")
    found = evaluate(foreground=photographs).foreground
    assert found is not None
    assert found.photographs == 1
    assert (found.fraction, found.density) == pytest.approx((whole.fraction, whole.density))
    assert len(found.failures) == 2
    run_evaluate()  # writes a sample
    result = run_command(["dev", "evaluate", str(tmp_path), "--foreground", str(photographs)])
    assert result.exit_code == 1
    assert "foreground: fraction" in result.stdout
    for name in ("b.png", "c.png"):
        (photographs / name).write_bytes(b"damaged")
    with pytest.raises(ImageError, match=r"a\.png"):
        evaluate(foreground=photographs)


def test_probabilities_are_calibrated_against_masks_and_labels(tmp_path: Path, photo) -> None:
    import json

    from tests.command_line import run_command

    Image.fromarray(photo).save(tmp_path / "a.png")
    found = evaluate(samples=tmp_path, scales=[0.5])
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
    found = evaluate(samples=tmp_path, scales=(0.5, 1))
    images = {scale: score.images for (scale, _), score in found.scales.items()}
    assert images == {0.5: 1, 1: 3}
    assert len(found.failures) == 2
    for name, failure in zip("ac", found.failures, strict=True):
        assert f"{name}.png" in failure
