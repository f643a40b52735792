from __future__ import annotations

import webbrowser
from pathlib import Path
from urllib.request import url2pathname

import numpy as np
import pytest
from tests.command_line import run_command

from deepdetect import Keypoints, load_image, match_features, save_keypoints, save_matches


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    addresses: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: addresses.append(address) or True)
    return addresses


def test_pages_and_what_they_are_beside(tmp_path: Path, opened: list[str]) -> None:
    for name in ("model.html", "model.ply", "model_depth.jpg", "model_depth.npz"):
        (tmp_path / name).touch()
        assert run_command(["view", str(tmp_path / name)]).exit_code == 0
    names = ["model.html", "model.html", "model_depth.jpg", "model_depth.jpg"]
    assert opened == [(tmp_path / name).as_uri() for name in names]
    (tmp_path / "other.ply").touch()
    assert run_command(["view", str(tmp_path / "other.ply")]).exit_code == 2
    assert run_command(["view", str(tmp_path / "nothing.ply")]).exit_code == 2


def test_keypoints_and_matches_are_drawn(
    photo: np.ndarray, photo_path: Path, tmp_path: Path, opened: list[str]
) -> None:
    xy = np.argwhere(np.ones((9, 7)))[:, ::-1] * 30.0
    descriptors = np.eye(len(xy), dtype=np.float32)
    found = Keypoints(xy, np.ones(len(xy)), photo.shape[1::-1], descriptors=descriptors)
    save_keypoints(found, tmp_path / "k.npz")
    matches = match_features(found, found)
    save_matches(matches, tmp_path / "m.npz")
    for name, images, expected in (
        ("k.npz", [photo_path], found.draw(photo)),
        ("m.npz", [photo_path] * 2, matches.draw(photo, photo)),
    ):
        result = run_command(["view", str(tmp_path / name), *map(str, images)])
        assert result.exit_code == 0, result.output
        assert " 63\n" in result.stdout
        picture = load_image(url2pathname(opened[-1].removeprefix("file://")))
        np.testing.assert_array_equal(picture, expected)
    assert run_command(["view", str(tmp_path / "k.npz")]).exit_code == 2
    assert run_command(["view", str(tmp_path / "k.npz"), *[str(photo_path)] * 2]).exit_code == 2
