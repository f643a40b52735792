from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetect, ImageError
from deepdetect.detector.pretrained import pretrained_weights
from deepdetect.evaluation.mask_scores import MaskScore, mean_score, score_heatmap, score_samples


def test_known_answers() -> None:
    heatmap = np.array([[0.9, 0.8, 0.2, 0.4]])
    mask = np.array([[True, False, True, False]])
    score = score_heatmap(heatmap, mask)
    assert score.loss == pytest.approx(-np.log([0.9, 0.2, 0.2, 0.6]).mean())
    assert score.iou == pytest.approx(1 / 3)


def test_empty_masks_agree() -> None:
    assert score_heatmap(np.zeros((4, 4)), np.zeros((4, 4), bool)).iou == 1


def test_certain_and_wrong_is_finite() -> None:
    assert score_heatmap(np.ones((4, 4)), np.zeros((4, 4), bool)).loss == pytest.approx(
        -np.log(1e-7)
    )


def test_the_loss_is_torch_s() -> None:
    torch = pytest.importorskip("torch", reason="needs torch, which is for training only")
    rng = np.random.default_rng(0)
    logits, mask = rng.normal(0, 3, (32, 32)).astype(np.float32), rng.random((32, 32)) < 0.3
    expected = torch.nn.functional.binary_cross_entropy_with_logits(
        torch.from_numpy(logits), torch.from_numpy(mask).float()
    )
    assert score_heatmap(1 / (1 + np.exp(-logits)), mask).loss == pytest.approx(
        float(expected), abs=1e-5
    )


def test_images_count_the_same() -> None:
    mean = mean_score([MaskScore(1, 0.2, 1), MaskScore(3, 0.4, 1)])
    assert (mean.loss, mean.iou, mean.images) == (2, pytest.approx(0.3), 2)
    with pytest.raises(ImageError):
        mean_score([])


def test_samples_without_a_mask_are_an_error(tmp_path: Path, photo: np.ndarray) -> None:
    from PIL import Image

    Image.fromarray(photo).save(tmp_path / "image_1.png")
    with pytest.raises(ImageError, match="mask"):
        score_samples(lambda rgb: np.zeros(rgb.shape[:2]), tmp_path)


def bundled_scores(shared: Path, backend: str) -> dict[str, MaskScore]:
    pytest.importorskip(backend, reason=f"needs {backend}")
    weights = pretrained_weights()
    if backend == "torch":
        weights = weights.with_suffix(".safetensors")
    detector = DeepDetect(weights, backend=backend)
    return score_samples(detector.heatmap, shared / "data" / "label-samples" / "val")


@pytest.mark.parametrize("backend", ["onnxruntime", "openvino", "torch"])
def test_pretrained_weights_score_as_their_model_card_says(shared: Path, backend: str) -> None:
    """The card's first two rows, so that it cannot fall behind the weights."""
    card = pretrained_weights().with_name("MODEL_CARD.md").read_text()
    scores = bundled_scores(shared, backend)
    for name, light in (("normal", "normal"), ("low", "darkened")):
        row = re.search(rf"published validation samples, {light} \| 5 \| ([\d.]+) / ([\d.]+)", card)
        assert scores[name].loss == pytest.approx(float(row[1]), abs=0.0005)
        assert scores[name].iou == pytest.approx(float(row[2]), abs=0.002)


def test_pretrained_weights_reach_the_bar(shared: Path) -> None:
    """What was asked of weights from two CPU cores alone: BCE and IoU of the published samples."""
    scores = bundled_scores(shared, "onnxruntime")
    assert scores["normal"].loss <= 0.125
    assert scores["normal"].iou >= 0.83
    assert scores["low"].loss <= 0.165
    assert scores["low"].iou >= 0.64
