from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from deepdetect import DeepDetect, OptionError

from .conftest import Views

torch = pytest.importorskip("torch", reason="needs torch")
transformers = pytest.importorskip("transformers", reason="needs transformers")
drop_in = pytest.importorskip("deepdetect.integrations.transformers")

from deepdetect.detector.network.weights import NETWORKS, save_tensors  # noqa: E402


@pytest.fixture(scope="module")
def model() -> Any:
    return drop_in.DeepDetectForKeypointDetection.from_deepdetect()


@pytest.fixture(scope="module")
def processor() -> Any:
    return drop_in.DeepDetectImageProcessor()


def run(model: Any, inputs: Any) -> Any:
    with torch.inference_mode():
        return model(**inputs)


def test_it_gives_what_onnx_gives(views: Views, model: Any, processor: Any) -> None:
    detector = DeepDetect(backend="onnxruntime")
    for image in (views.first, views.first[:195, :251]):  # no multiples of 8
        output = run(model, processor(image, return_tensors="pt"))
        height, width = image.shape[:2]
        probability = torch.sigmoid(output.logits[0, :height, :width]).numpy()
        assert np.abs(probability - detector.heatmap(image)).max() < 1e-5
        (found,) = processor.post_process_keypoint_detection(output, [(height, width)])
        expected = detector.detect(image)
        assert abs(len(found["scores"]) - len(expected)) <= 2  # at the threshold
        if len(found["scores"]) == len(expected):
            assert np.abs(found["keypoints"].numpy() - expected.xy).max() < 1e-4
            assert np.abs(found["scores"].numpy() - expected.scores).max() < 1e-5


@pytest.mark.parametrize("name", NETWORKS)
def test_the_network_is_the_one_of_the_weights(name: str, tmp_path: Path) -> None:
    save_tensors(NETWORKS[name]().state_dict(), tmp_path / "weights.safetensors", {})
    make = drop_in.DeepDetectForKeypointDetection
    model = make.from_deepdetect(tmp_path / "weights.safetensors")
    model.save_pretrained(tmp_path)
    again = make.from_pretrained(tmp_path)
    assert type(again.network) is NETWORKS[name]
    state = again.network.state_dict()
    assert all(torch.equal(state[key], value) for key, value in model.network.state_dict().items())


OFFLINE = """
import json, sys
import numpy as np, torch, transformers
from deepdetect.integrations.transformers import register

register()
folder, image = sys.argv[1:]
model = transformers.AutoModelForKeypointDetection.from_pretrained(folder)
processor = transformers.AutoImageProcessor.from_pretrained(folder)
with torch.inference_mode():
    output = model(**processor(image, return_tensors="pt"))
np.save(folder + "/logits.npy", output.logits.numpy())
print(json.dumps([type(model).__name__, type(processor).__name__, processor.max_pixels,
                  model.config.max_keypoints, int(output.mask.sum())]))
"""


def test_what_was_saved_is_loaded_without_network(views: Views, model: Any, tmp_path: Path) -> None:
    copy = drop_in.DeepDetectForKeypointDetection.from_deepdetect(max_keypoints=100)
    copy.save_pretrained(tmp_path)
    drop_in.DeepDetectImageProcessor(max_pixels=10**6).save_pretrained(tmp_path)
    Image.fromarray(views.first).save(tmp_path / "photo.png")
    done = subprocess.run(
        [sys.executable, "-c", OFFLINE, str(tmp_path), str(tmp_path / "photo.png")],
        env={**os.environ, "HF_HUB_OFFLINE": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    names = ["DeepDetectForKeypointDetection", "DeepDetectImageProcessor", 10**6, 100, 100]
    assert json.loads(done.stdout.splitlines()[-1]) == names
    logits = run(model, drop_in.DeepDetectImageProcessor()(views.first, return_tensors="pt")).logits
    saved = torch.from_numpy(np.load(tmp_path / "logits.npy"))
    assert torch.equal(saved, logits)
    probability = torch.sigmoid(saved[0]).numpy()
    onnx = DeepDetect(backend="onnxruntime").heatmap(views.first)
    assert np.abs(probability - onnx).max() < 1e-5
    again = drop_in.DeepDetectForKeypointDetection.from_pretrained(tmp_path, nms_radius=2)
    assert again.config.nms_radius == 2
    assert again.config.max_keypoints == 100


def test_a_batch_of_unequal_sizes(views: Views, model: Any, processor: Any) -> None:
    small = views.first[:120, :160]
    inputs = processor([views.first, small], return_tensors="pt")
    assert inputs["pixel_values"].shape == (2, 3, 200, 256)
    output = run(model, inputs)
    assert output.mask.shape == output.scores.shape == output.keypoints.shape[:2]
    sizes = [views.first.shape[:2], small.shape[:2]]
    results = processor.post_process_keypoint_detection(output, sizes)
    for image, found in zip((views.first, small), results, strict=True):
        (alone,) = processor.post_process_keypoint_detection(
            run(model, processor(image, return_tensors="pt")), [image.shape[:2]]
        )
        assert torch.allclose(found["keypoints"], alone["keypoints"], atol=1e-4)
        assert torch.allclose(found["scores"], alone["scores"], atol=1e-5)
    outside = output.logits[1][inputs["pixel_mask"][1] == 0]
    assert torch.sigmoid(outside).max() < 1e-30
    with pytest.raises(OptionError, match="`target_sizes`"):
        processor.post_process_keypoint_detection(output, sizes[:1])


def test_images_scaled_down_keep_their_pixel_centres(model: Any, views: Views) -> None:
    large = cv2.resize(views.first, None, fx=3, fy=3, interpolation=cv2.INTER_NEAREST)
    processor = drop_in.DeepDetectImageProcessor(max_pixels=views.first[..., 0].size)
    inputs = processor(large, return_tensors="pt")
    assert inputs["pixel_values"].shape[2:] == (200, 256)
    (found,) = processor.post_process_keypoint_detection(run(model, inputs), [large.shape[:2]])
    (small,) = processor.post_process_keypoint_detection(
        run(model, drop_in.DeepDetectImageProcessor()(views.first, return_tensors="pt")),
        [views.first.shape[:2]],
    )
    # Of three pixels in a row that are one in the small image, the middle one.
    assert torch.allclose(found["keypoints"], 3 * small["keypoints"] + 1, atol=1e-3)


def test_it_can_be_trained(views: Views, processor: Any) -> None:
    model = drop_in.DeepDetectForKeypointDetection.from_deepdetect()
    inputs = processor(views.first, return_tensors="pt")
    labels = (torch.from_numpy(DeepDetect().heatmap(views.first)) < 0.5)[None]
    optimizer = torch.optim.Adam(model.parameters(), 1e-3)
    losses = []
    for _ in range(3):
        output = model(**inputs, labels=labels)
        losses.append(float(output.loss.detach()))
        optimizer.zero_grad()
        output.loss.backward()
        optimizer.step()
    assert losses[-1] < losses[0]
    as_tuple = model(**inputs, labels=labels, return_dict=False)
    assert [tuple(part.shape) for part in as_tuple[:2]] == [(), (1, 200, 256)]


def test_options(views: Views, processor: Any) -> None:
    drop_in.register()
    drop_in.register()  # twice does no harm
    assert transformers.AutoConfig.for_model("deepdetect", max_keypoints=7).max_keypoints == 7
    dense = drop_in.DeepDetectForKeypointDetection.from_deepdetect(
        "dense", max_keypoints=50, nms_radius=3
    )
    output = run(dense, processor(views.first, return_tensors="pt"))
    (found,) = processor.post_process_keypoint_detection(output, [views.first.shape[:2]])
    expected = DeepDetect("dense", backend="onnxruntime").detect(
        views.first, max_keypoints=50, nms_radius=3
    )
    assert np.abs(found["keypoints"].numpy() - expected.xy).max() < 1e-2
