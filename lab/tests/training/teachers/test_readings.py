from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree
from tests.command_line import run_command

from deepdetect import OptionError
from deepdetect.detector.points.detection import least_distances, rank_candidates
from deepdetect.detector.points.hessian_scales import build_scale_space
from deepdetect.features.selection import suppress_neighbors
from deepdetect.io.image import find_images, load_image, luma
from deepdetect_lab.training.teachers import readings
from deepdetect_lab.training.teachers.readings import (
    POINTS,
    STRONG_DENSITY,
    Reading,
    Teachers,
    Whitening,
    choose_points,
    load_reading,
    read_photograph,
    reading_file,
    write_readings,
)


def test_points_are_strong_and_weak_ones(textures: Path) -> None:
    gray = luma(load_image(textures / "0.png"))
    xy, sizes = choose_points(gray, np.random.default_rng(0))
    assert len(xy) == len(sizes) == POINTS
    assert len(np.unique(xy, axis=0)) == POINTS
    candidates, logits = rank_candidates(build_scale_space(gray))
    order = suppress_neighbors(candidates.xy, logits, least_distances(candidates.sigma_px))
    gaps, ranks = KDTree(candidates.xy[order]).query(xy)
    assert not gaps.any()
    assert (ranks < STRONG_DENSITY * gray.size).sum() == POINTS // 2
    assert (np.diff(ranks) > 0).all()
    assert ((xy > 0) & (xy < 479)).all()


@pytest.mark.parametrize("shape", [(64, 96), (70, 90)])
def test_both_teachers_are_read_at_the_points(teachers: Teachers, shape: tuple[int, int]) -> None:
    rgb = np.zeros((*shape, 3), np.uint8)
    rgb[:] = np.linspace(0, 250, shape[1])[None, :, None]
    xy = np.array([[20.0, 30], [60, 30], [70.3, 50.6]])
    codes, scores = teachers.read(rgb, xy)
    np.testing.assert_allclose(np.linalg.norm(codes[:, :64], axis=1), 1, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(codes[:, 64:], axis=1), 1, atol=1e-5)
    assert scores.shape == (3,)
    assert codes.shape == (3, 192)
    assert codes[2, 0] > codes[1, 0] > codes[0, 0] > 0


def test_an_interrupted_reading_is_resumed(
    teachers: Teachers, textures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(readings, "POINTS", 60)
    images = find_images(textures)
    first = next(write_readings(images, tmp_path, teachers))
    assert [path.name for path in tmp_path.iterdir()] == [reading_file(images[0], tmp_path).name]
    assert len(list(write_readings(images, tmp_path, teachers))) == len(images) - 1
    assert list(write_readings(images, tmp_path, teachers)) == []
    stored = load_reading(reading_file(images[0], tmp_path))
    known = read_photograph(teachers, images[0])
    assert first == len(stored.xy) == 60
    for values, expected in zip(stored, known, strict=True):
        np.testing.assert_array_equal(values, expected)
        assert values.dtype == expected.dtype


def test_whitening_makes_variances_more_alike(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(readings, "SOME_POINTS", POINTS)
    deviations = np.full(192, 0.1)
    deviations[64:] = np.linspace(0.1, 0.4, 128)
    rng = np.random.default_rng(0)
    codes = 1 + rng.normal(size=(20_000, 192)) * deviations
    none = dict.fromkeys(Reading._fields, np.zeros(0))
    np.savez(tmp_path / "0.npz", **none | {"codes": codes.astype(np.float16)})
    whiten = Whitening([tmp_path / "0.npz"])
    found = whiten(torch.from_numpy(codes))
    torch.testing.assert_close(found.norm(dim=-1), torch.ones(len(found)))
    torch.testing.assert_close(found.mean(0), torch.zeros(192), atol=0.01, rtol=0)
    shares = found.square().split([64, 128], 1)
    torch.testing.assert_close(shares[0].sum(1) / shares[1].sum(1), torch.full((20_000,), 0.36))
    # Deviations to the power of 1 - 0.75: between axes that differ fourfold, a factor of 1.41.
    after = found.std(0)[64:].numpy()
    assert after[-16:].mean() / after[:16].mean() == pytest.approx(
        (deviations[-16:].mean() / deviations[64:80].mean()) ** 0.25, rel=0.1
    )


def test_without_readings_there_is_nothing_to_whiten() -> None:
    with pytest.raises(OptionError, match="read the teachers first"):
        Whitening([])


def test_the_commands_read_and_learn(
    teacher_files: tuple[Path, Path],
    textures: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    edgepoint, aliked = teacher_files
    reading = ["dev", "read-teachers", textures, "-o", "readings", "--edgepoint", edgepoint]
    done = run_command([*map(str, [*reading, "--aliked", aliked, "--json"])])
    assert done.exit_code == 0, done.output
    values = json.loads(done.stdout)
    assert (values["read"], values["skipped"]) == (4, 0)
    assert values["points"] > 1000
    monkeypatch.setattr("deepdetect_lab.training.descriptor.task.VAL_CROPS", 1)
    learning = ["train-descriptor", textures, "--validation", textures, "-o", "taught"]
    options = ["--crops", "1", "--readings", "readings", "--steps", "1", "--pairs", "1"]
    counts = ["--val-count", "1", "--val-pairs", "1", "--device", "cpu", "--json"]
    done = run_command([*map(str, [*learning, *options, *counts])])
    assert done.exit_code == 0, done.output
    values = json.loads(done.stdout)
    assert Path(values["onnx"]).is_file()
    assert Path(values["weights"]).is_file()
