from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from deepdetect.geometry.camera import Camera
from deepdetect.geometry.posed_view import PosedView

pytest.importorskip("pycolmap", reason="needs the extra sfm")


def posed(name: str, centre: np.ndarray) -> PosedView:
    return PosedView(name, Camera((400, 300), 600.0), np.eye(3), -centre)


def test_cameras_are_compared_with_the_true_ones(load_script: Callable[[str], ModuleType]) -> None:
    script = load_script("many_photographs")
    centres = np.random.default_rng(0).uniform(-2, 2, (6, 3))
    truth = {name: posed(name, centre) for name, centre in zip("abcdef", centres, strict=True)}
    # Half the size, elsewhere, and without the last camera: 10 of 15 pairs are left.
    own = {name: posed(name, truth[name].centre / 2 + 7) for name in "abcde"}
    assert script.compare_cameras(own, truth).splitlines() == [
        "centres 0.00 mm (mean), 0.00 mm (largest)",
        "relative poses 0.00° (median), AUC 0.667 at 1°, 0.667 at 5°",
    ]


def test_a_model_of_other_photographs_is_refused(
    load_script: Callable[[str], ModuleType], shared: Path, tmp_path: Path
) -> None:
    import pycolmap

    script = load_script("many_photographs")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_points3D = 20
    pycolmap.synthesize_dataset(options).write(tmp_path)
    (scene,) = script.load_posed_scenes(shared / "data" / "fountain")
    with pytest.raises(SystemExit, match="of the model is no photograph of fountain"):
        script.show_model(scene, tmp_path)
