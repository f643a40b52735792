from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from deepdetect.io.image import luma
from deepdetect_lab.datasets.planar import OXFORD_KINDS, read_matrix

MOVE = np.array([[1.01, 0.02, 3.0], [-0.02, 0.99, 2.0], [1e-4, 0, 1.0]])
WRONG = np.array([[1.0, 0, 1.6], [0, 1, -1.2], [0, 0, 1]])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, write_scene: Callable[..., None]) -> Path:
    """Eight scenes, whose published homographies are 2 px off in graf and true elsewhere."""
    root = tmp_path_factory.mktemp("refine") / "oxford"
    write_scene(root / "graf", (180, 140), MOVE, fading=0.03)
    for scene in OXFORD_KINDS:
        if scene != "graf":
            write_scene(root / scene, (48, 40), np.eye(3))
    for number in range(2, 7):
        path = root / "graf" / f"H1to{number}p"
        shutil.copy(path, path.with_name(f"true{number}"))
        np.savetxt(path, WRONG @ read_matrix(path))
    return root


@pytest.fixture(scope="module")
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("refine_oxford")


@pytest.fixture(scope="module")
def refined(
    script: ModuleType, folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[list, Path]:
    output = tmp_path_factory.mktemp("refined")
    results = script.refine_oxford(folder, output)
    assert len(results) == 40
    return results, output


@pytest.mark.slow
def test_wrong_homographies_become_true(
    script: ModuleType, folder: Path, refined: tuple[list, Path]
) -> None:
    for number in range(2, 5):  # later ones share little with the first
        true = read_matrix(folder / "graf" / f"true{number}")
        found = read_matrix(refined[1] / "graf" / f"H1to{number}p.refined")
        published = read_matrix(folder / "graf" / f"H1to{number}p")
        assert script.displacement(true, published, (180, 140), (180, 140))[0] > 1.5
        assert script.displacement(true, found, (180, 140), (180, 140))[0] < 0.3


@pytest.mark.slow
def test_true_homographies_are_left_alone(refined: tuple[list, Path]) -> None:
    written = {path.parent.name for path in refined[1].rglob("*.refined")}
    assert written == {"graf"}
    for row in refined[0]:
        assert row["correlation, refined"] >= row["correlation, published"]
        assert (row["written"] == "yes") == row["pair"].startswith("graf")


@pytest.mark.slow
def test_the_table_tells_what_moved(refined: tuple[list, Path]) -> None:
    rows = {row["pair"]: row for row in refined[0]}
    assert len(rows) == 40
    assert rows["graf 1-2"]["moved, median px"] == pytest.approx(2, abs=0.4)
    assert rows["bark 1-2"]["moved, median px"] == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize(
    ("gain", "risen", "apart", "better"),
    [
        (0.05, 0.52, None, True),  # a clear gain needs nothing else
        (0.003, 0.65, 0.02, True),  # blurred: little gain, but nearly everywhere
        (0.003, 0.56, 0.02, False),  # a gain in a part of the image at the cost of the rest
        (0.003, 0.65, 0.2, False),  # from each start somewhere else
        (0.003, 0.65, None, False),  # nothing confirms it
        (0.0, 0.0, 0.02, False),
    ],
)
def test_better_is_a_clear_gain_or_a_clear_majority_with_both_starts(
    script: ModuleType, gain: float, risen: float, apart: float | None, better: bool
) -> None:
    assert script.is_better(gain, 0.3, risen, apart) is better


def test_the_correlation_rises_in_nearly_all_windows_under_the_truth(
    script: ModuleType, photo: np.ndarray
) -> None:
    gray = luma(photo)
    shift = np.array([[1.0, 0, 3], [0, 1, -2], [0, 0, 1]])
    size = (gray.shape[1], gray.shape[0])
    moved = cv2.GaussianBlur(cv2.warpPerspective(gray, shift, size), (0, 0), 1.5)
    wrong = shift + np.array([[0, 0, 1.2], [0, 0, 0.8], [0, 0, 0]])
    assert script.risen_fraction(gray, moved, wrong, shift) > 0.8
    assert script.risen_fraction(gray, moved, shift, wrong) < 0.2
    assert script.risen_fraction(gray, moved, shift, shift) == 0
