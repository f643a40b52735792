from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from deepdetect.datasets.foreground import MaskedPhotograph, load_foreground
from deepdetect.evaluation.baselines import CLASSICAL, every_pixel_method
from deepdetect.evaluation.protocols.foreground import foreground_table
from deepdetect.evaluation.workspace import Workspace


@pytest.fixture
def photographs(tmp_path: Path, photo: np.ndarray) -> list[MaskedPhotograph]:
    for name, left, share in (("a", 60, 30), ("b", 120, 50)):
        Image.fromarray(photo[60:120, left : left + 80]).save(tmp_path / f"{name}.png")
        mask = np.zeros((60, 80), np.uint8)
        mask[10:50, :share] = 255
        Image.fromarray(mask).save(tmp_path / f"{name}_mask.png")
    return load_foreground(tmp_path)


def test_the_share_equals_a_count_under_the_mask(photographs, tmp_path: Path) -> None:
    table = foreground_table(Workspace(tmp_path), [CLASSICAL["fast"]], photographs)
    shares, densities, covered = [], [], []
    for photograph in photographs:
        gray = cv2.cvtColor(cv2.imread(str(photograph.image)), cv2.COLOR_BGR2GRAY)
        mask = cv2.imread(str(photograph.mask), cv2.IMREAD_GRAYSCALE)
        points = cv2.FastFeatureDetector_create().detect(gray, None)
        shares.append(np.mean([mask[int(p.pt[1]), int(p.pt[0])] > 0 for p in points]))
        densities.append(len(points) / gray.size)
        covered.append((mask > 0).mean())
    (row,) = table.rows
    expected = (np.mean(shares), np.mean(shares) / np.mean(covered), np.mean(densities))
    np.testing.assert_allclose(row[1:], expected)


def test_every_pixel_reaches_what_random_points_do(photographs, tmp_path: Path) -> None:
    (row,) = foreground_table(Workspace(tmp_path), [every_pixel_method()], photographs).rows
    np.testing.assert_allclose(row[1:], (40 * 40 / 4800, 1, 1))


def test_photographs_without_a_keypoint_are_left_out_and_said(photographs, tmp_path: Path) -> None:
    Image.fromarray(np.full((60, 80, 3), 90, np.uint8)).save(photographs[0].image)
    workspace = Workspace(tmp_path)
    (row,) = foreground_table(workspace, [CLASSICAL["fast"]], photographs).rows
    alone = foreground_table(Workspace(tmp_path), [CLASSICAL["fast"]], photographs[1:]).rows[0]
    assert row[1] == alone[1]
    assert row[3] == alone[3] / 2
    (note,) = workspace.left_out
    assert "1 photographs without a keypoint" in note


def test_another_mask_is_judged_anew(photographs, tmp_path: Path) -> None:
    from deepdetect.evaluation.cache import StageCache

    workspace = Workspace(tmp_path, StageCache(tmp_path / "cache"))
    every = every_pixel_method()
    (before,) = foreground_table(workspace, [every], photographs[:1]).rows
    swapped = dataclasses.replace(photographs[0], mask=photographs[1].mask)
    (after,) = foreground_table(workspace, [every], [swapped]).rows
    assert before[1] == pytest.approx(40 * 30 / 4800)
    assert after[1] == pytest.approx(40 * 50 / 4800)


def test_a_mask_of_another_size_is_left_out(photographs, tmp_path: Path) -> None:
    """It would be read at the wrong places."""
    Image.fromarray(np.full((30, 40), 255, np.uint8)).save(photographs[0].mask)
    workspace = Workspace(tmp_path)
    foreground_table(workspace, [CLASSICAL["fast"]], photographs)
    assert any("a.png" in note for note in workspace.left_out)
