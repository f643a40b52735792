from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from PIL import Image

from deepdetect_lab.datasets.foreground import MaskedPhotograph, load_foreground
from deepdetect_lab.evaluation.baselines.method import LocalFeature
from deepdetect_lab.evaluation.baselines.opencv import CLASSICAL
from deepdetect_lab.evaluation.baselines.random import all_pixels_feature
from deepdetect_lab.evaluation.protocols.paper import foreground
from deepdetect_lab.evaluation.run import Run


@pytest.fixture
def photographs(tmp_path: Path, photo: np.ndarray) -> list[MaskedPhotograph]:
    for name, left, share in (("a", 60, 30), ("b", 120, 50)):
        Image.fromarray(photo[60:120, left : left + 80]).save(tmp_path / f"{name}.png")
        mask = np.zeros((60, 80), np.uint8)
        mask[10:50, :share] = 255
        Image.fromarray(mask).save(tmp_path / f"{name}_mask.png")
    return load_foreground(tmp_path)


def measured(run: Run, feature: LocalFeature) -> list[float]:
    """Return fraction on the foreground, fraction over that of random points, and density."""
    (section,) = foreground(run, SimpleNamespace(density_features=lambda: (feature,)))
    (table,) = section.tables
    assert list(table.columns)[1:3] == [
        "fraction on the foreground",
        "fraction on the foreground, in the paper",
    ]
    (row,) = table.rows
    names = "fraction on the foreground", "over that of random points", "keypoints per pixel"
    return [row[name] for name in names]


def test_the_share_equals_a_count_under_the_mask(photographs, tmp_path: Path) -> None:
    found = measured(Run(tmp_path), CLASSICAL["fast"])
    shares, densities, covered = [], [], []
    for photograph in photographs:
        gray = cv2.cvtColor(cv2.imread(str(photograph.image)), cv2.COLOR_BGR2GRAY)
        mask = cv2.imread(str(photograph.mask), cv2.IMREAD_GRAYSCALE)
        points = cv2.FastFeatureDetector_create().detect(gray, None)
        shares.append(np.mean([mask[int(p.pt[1]), int(p.pt[0])] > 0 for p in points]))
        densities.append(len(points) / gray.size)
        covered.append((mask > 0).mean())
    expected = (np.mean(shares), np.mean(shares) / np.mean(covered), np.mean(densities))
    np.testing.assert_allclose(found, expected)


def test_all_pixels_reach_what_random_points_do(photographs, tmp_path: Path) -> None:
    found = measured(Run(tmp_path), all_pixels_feature())
    np.testing.assert_allclose(found, (40 * 40 / 4800, 1, 1))


def test_images_without_a_keypoint_are_skipped_and_said(photographs, tmp_path: Path) -> None:
    Image.fromarray(np.full((60, 80, 3), 90, np.uint8)).save(photographs[0].image)
    run = Run(tmp_path)
    found = measured(run, CLASSICAL["fast"])
    photographs[0].image.unlink()
    photographs[0].mask.unlink()
    alone = measured(Run(tmp_path), CLASSICAL["fast"])
    assert found[:2] == alone[:2]
    assert found[2] == alone[2] / 2
    assert len(run.skipped) == 1


def test_masks_of_another_size_and_damaged_ones_are_skipped(photographs, tmp_path: Path) -> None:
    """It would be read at the wrong places."""
    Image.fromarray(np.full((30, 40), 255, np.uint8)).save(photographs[0].mask)
    photographs[1].mask.write_text("no picture")
    measured(run := Run(tmp_path), CLASSICAL["fast"])
    assert [note.split(": ")[0][-5:] for note in run.skipped] == ["a.png", "b.png"]
