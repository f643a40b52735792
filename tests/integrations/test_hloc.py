"""With hloc where it is installed, else with a base class of the same contract."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image

from deepdetect import PointDetector

from .conftest import Views

torch = pytest.importorskip("torch", reason="needs torch")

BASE_MODEL = """
import torch

class BaseModel(torch.nn.Module):
    default_conf = {}
    required_inputs = []

    def __init__(self, conf):
        super().__init__()
        self.conf = {**self.default_conf, **conf}
        self._init(self.conf)

    def forward(self, data):
        assert set(self.required_inputs) <= set(data)
        return self._forward(data)
"""
STAND_IN = {
    "hloc/__init__.py": "",
    "hloc/extractors/__init__.py": "",
    "hloc/matchers/__init__.py": "",
    "hloc/utils/__init__.py": "",
    "hloc/utils/base_model.py": BASE_MODEL,
}


@pytest.fixture
def load(drop_in: Callable[..., ModuleType]) -> Callable[[str, dict[str, Any]], Any]:
    """Make a model as hloc does: by the name of a module, which holds one model."""
    drop_in("hloc", STAND_IN).register()

    def make(kind: str, conf: dict[str, Any]) -> Any:
        base = importlib.import_module("hloc.utils.base_model").BaseModel
        module = importlib.import_module(f"hloc.{kind}.{conf['name']}")
        (model,) = (
            found
            for _, found in inspect.getmembers(module, inspect.isclass)
            if found.__module__ == module.__name__ and issubclass(found, base)
        )
        return model(conf).eval()

    return make


def batch(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(image.copy()).permute(2, 0, 1)[None].float() / 255


def test_the_extractor_gives_described_points(views: Views, load: Callable[..., Any]) -> None:
    expected = PointDetector(100).detect(views.first)
    model = load("extractors", {"name": "deepdetect", "max_keypoints": 100})
    found = model({"image": batch(views.first)})
    assert {name: tuple(value.shape) for name, value in found.items()} == {
        "keypoints": (1, 100, 2),
        "scores": (1, 100),
        "descriptors": (1, 64, 100),
        "scales": (1, 100),
        "oris": (1, 100),
    }
    assert np.array_equal(found["keypoints"][0], expected.xy)
    assert found["keypoints"].dtype == torch.float64  # hloc halves what is float32
    assert np.array_equal(found["oris"][0], expected.angles)
    assert torch.allclose(found["descriptors"][0].norm(dim=0), torch.ones(100))
    turned = load(
        "extractors", {"name": "deepdetect", "max_keypoints": 100, "angle_unit": "radians"}
    )({"image": batch(views.first)})
    assert torch.allclose(turned["oris"], torch.deg2rad(found["oris"]))


def test_matches_of_two_views(views: Views, load: Callable[..., Any]) -> None:
    extractor = load("extractors", {"name": "deepdetect", "max_keypoints": 500})
    features = [extractor({"image": batch(image)}) for image in (views.first, views.second)]
    # As hloc stores them by default, and reads them again.
    data = {
        f"{name}{row}": (value.half() if value.dtype == torch.float32 else value).float()
        for row, found in enumerate(features)
        for name, value in found.items()
    }
    any_program = load("matchers", {"name": "deepdetect"})(data)["matches0"]
    found = load("matchers", {"name": "deepdetect", "descriptor": "learned"})(data)
    assert (found["matches0"] >= 0).sum() > (any_program >= 0).sum() > 150
    matches, scores = found["matches0"], found["matching_scores0"]
    assert matches.shape == scores.shape == (1, 500)
    rows0 = np.flatnonzero(matches[0] >= 0)
    assert len(rows0) > 150
    assert (scores[0][matches[0] < 0] == 0).all()
    points0, points1 = (found["keypoints"][0].numpy() for found in features)
    assert views.correct(points0[rows0], points1[matches[0, rows0]]) > 0.9
    none = {**data, "descriptors1": data["descriptors1"][:, :, :0]}
    assert (load("matchers", {"name": "deepdetect"})(none)["matches0"] == -1).all()


def test_dense_matches_of_two_views(views: Views, load: Callable[..., Any]) -> None:
    data = {"image0": batch(views.first), "image1": batch(views.second)}
    found = load("matchers", {"name": "deepdetect_dense"})(data)
    points0, points1 = found["keypoints0"].numpy(), found["keypoints1"].numpy()
    assert len(points0) == len(points1) == len(found["scores"]) > 3000
    assert views.correct(points0, points1) > 0.95


@pytest.mark.skipif(
    importlib.util.find_spec("hloc") is None, reason="needs hloc, which is not on PyPI"
)
@pytest.mark.filterwarnings("ignore")  # of its loader, where there is no GPU
def test_hloc_itself_writes_and_matches(views: Views, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    from hloc import extract_features, match_dense, match_features

    from deepdetect.integrations import hloc

    hloc.register()
    images = tmp_path / "images"
    images.mkdir()
    for name, view in (("a.png", views.first), ("b.png", views.second)):
        Image.fromarray(view).save(images / name)
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("a.png b.png\n")
    features = extract_features.main(hloc.EXTRACTOR_CONF, images, tmp_path)
    expected = PointDetector(4096).detect(views.first)
    with h5py.File(features) as file:
        assert np.abs(file["a.png/keypoints"][:] - expected.xy).max() < 1e-4
    matches = match_features.main(
        hloc.MATCHER_CONF, pairs, features, matches=tmp_path / "matches.h5"
    )
    dense = tmp_path / "dense.h5"
    match_dense.match_dense(hloc.DENSE_MATCHER_CONF, [("a.png", "b.png")], images, dense)
    with h5py.File(matches) as file, h5py.File(features) as found:
        rows = file["a.png/b.png/matches0"][:]
        rows0 = np.flatnonzero(rows >= 0)
        points0, points1 = (found[f"{name}/keypoints"][:] for name in ("a.png", "b.png"))
        assert views.correct(points0[rows0], points1[rows[rows0]]) > 0.9
    with h5py.File(dense) as file:
        group = file["a.png/b.png"]
        assert views.correct(group["keypoints0"][:], group["keypoints1"][:]) > 0.95
