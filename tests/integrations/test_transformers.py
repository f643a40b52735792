"""The folders for model hubs load in transformers, by the code inside them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from deepdetect import DeepDetect
from deepdetect.detector.heatmap import HeatmapOptions, seen_size
from deepdetect.detector.pretrained import PRETRAINED

from .conftest import Views

torch = pytest.importorskip("torch", reason="needs torch")
transformers = pytest.importorskip("transformers", reason="needs transformers")


@pytest.fixture
def load(hub: Path) -> Callable[..., Any]:
    """Load what transformers makes of a folder: a model, and what prepares its images."""

    def made(name: str = "default", **options: Any) -> Any:
        folder = hub / f"deepdetect-{name}"
        model, processor = (
            kind.from_pretrained(folder, trust_remote_code=True, **options)
            for kind in (
                transformers.AutoModelForKeypointDetection,
                transformers.AutoImageProcessor,
            )
        )
        return SimpleNamespace(model=model, processor=processor)

    return made


def run(loaded: Any, *images: np.ndarray) -> tuple[Any, list[dict[str, Any]]]:
    with torch.inference_mode():
        output = loaded.model(**loaded.processor(list(images), return_tensors="pt"))
    sizes = [image.shape[:2] for image in images]
    return output, loaded.processor.post_process_keypoint_detection(output, sizes)


@pytest.mark.parametrize("name", PRETRAINED)
def test_it_gives_what_onnx_gives(name: str, views: Views, load: Callable[..., Any]) -> None:
    detector, loaded = DeepDetect(name, backend="onnxruntime"), load(name)
    for image in (views.first, views.first[:195, :251]):  # no multiples of 8
        output, (found,) = run(loaded, image)
        height, width = image.shape[:2]
        probability = torch.sigmoid(output.logits[0, :height, :width]).numpy()
        assert np.abs(probability - detector.heatmap(image)).max() < 1e-4
        expected = detector.detect(image)
        assert abs(len(found["scores"]) - len(expected)) <= 2  # at the threshold
        if len(found["scores"]) == len(expected):
            assert np.abs(found["keypoints"].numpy() - expected.xy).max() < 1e-4
            assert np.abs(found["scores"].numpy() - expected.scores).max() < 1e-4


def test_options_choose_as_detect_does(views: Views, load: Callable[..., Any]) -> None:
    how = {"max_keypoints": 50, "nms_radius": 3}
    _, (found,) = run(load(**how), views.first)
    expected = DeepDetect(backend="onnxruntime").detect(views.first, **how)
    assert np.abs(found["keypoints"].numpy() - expected.xy).max() < 1e-4


def test_a_batch_of_unequal_sizes(views: Views, load: Callable[..., Any]) -> None:
    loaded, images = load(), (views.first, views.first[:120, :160])
    output, results = run(loaded, *images)
    assert output.logits.shape == (2, 200, 256)
    assert output.mask.shape == output.scores.shape == output.keypoints.shape[:2]
    assert torch.sigmoid(output.logits[1, 120:]).max() < 1e-30
    for image, found in zip(images, results, strict=True):
        _, (alone,) = run(loaded, image)
        assert torch.allclose(found["keypoints"], alone["keypoints"], atol=1e-4)
        assert torch.allclose(found["scores"], alone["scores"], atol=1e-5)


def test_images_of_any_kind(views: Views, load: Callable[..., Any], tmp_path: Path) -> None:
    processor = load().processor
    path = tmp_path / "photo.png"
    Image.fromarray(views.first).save(path)
    planes = torch.tensor(views.first).permute(2, 0, 1) / 255
    kinds = (views.first, path, str(path), Image.open(path), planes)
    for image in kinds:
        values = processor(image, return_tensors="np")["pixel_values"]
        np.testing.assert_array_equal(values[0], planes)
    gray = processor(views.first[:, :, 1], return_tensors="np")["pixel_values"]
    np.testing.assert_array_equal(gray[0], planes[[1, 1, 1]])


def test_large_images_are_scaled_down_as_the_detector_does(
    views: Views, load: Callable[..., Any]
) -> None:
    large = cv2.resize(views.first, (2110, 1402), interpolation=cv2.INTER_CUBIC)
    found = load().processor(large, return_tensors="np")["pixel_values"][0]
    size = seen_size(large.shape, HeatmapOptions())
    expected = cv2.resize(large, size, interpolation=cv2.INTER_AREA).transpose(2, 0, 1)
    assert np.abs(found * 255 - expected).max() < 0.501


def test_it_can_be_trained(views: Views, load: Callable[..., Any]) -> None:
    loaded = load()
    inputs = loaded.processor(views.first, return_tensors="pt")
    labels = (torch.from_numpy(DeepDetect().heatmap(views.first)) < 0.5)[None]
    optimizer = torch.optim.Adam(loaded.model.parameters(), 1e-3)
    losses = []
    for _ in range(3):
        output = loaded.model(**inputs, labels=labels)
        losses.append(float(output.loss.detach()))
        optimizer.zero_grad()
        output.loss.backward()
        optimizer.step()
    assert losses[-1] < losses[0]
    as_tuple = loaded.model(**inputs, labels=labels, return_dict=False)
    assert [tuple(part.shape) for part in as_tuple[:2]] == [(), (1, 200, 256)]


OFFLINE = """
import json, sys
import transformers

made = [
    kind.from_pretrained(sys.argv[1], trust_remote_code=True)
    for kind in (transformers.AutoModelForKeypointDetection, transformers.AutoImageProcessor)
]
output = made[0](**made[1](sys.argv[2], return_tensors="pt"))
print(json.dumps([*(type(one).__name__ for one in made), int(output.mask.sum()),
                  "deepdetect" in sys.modules]))
"""


def test_what_was_saved_is_loaded_without_network_and_package(
    views: Views, load: Callable[..., Any], tmp_path: Path
) -> None:
    loaded = load(max_keypoints=100)
    loaded.model.save_pretrained(tmp_path / "saved")
    loaded.processor.save_pretrained(tmp_path / "saved")
    Image.fromarray(views.first).save(tmp_path / "photo.png")
    done = subprocess.run(
        [sys.executable, "-c", OFFLINE, tmp_path / "saved", tmp_path / "photo.png"],
        env={**os.environ, "HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path), "PYTHONPATH": ""},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    expected = ["DeepDetectForKeypointDetection", "DeepDetectImageProcessor", 100, False]
    assert json.loads(done.stdout.splitlines()[-1]) == expected
