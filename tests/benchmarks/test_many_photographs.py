from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from deepdetect.datasets.posed_images import PosedImage, PosedScene
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


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        (
            [[0.1, 1.5, 3], [0, 1, 3], [0.9, 2, 5.5]],
            [
                "100.0% of the dense points beside the path, 2 where it went",
                "of these 50.0% within 0.1 m of the road",
                "of these 50.0% within 0.2 m of the road",
                "of these 50.0% within 0.3 m of the road",
                "50.0% in the air, 0.0% under the road",
                "of all beside the path 0.0% over 10 m above the road, 0.0% over .5 m under it",
            ],
        ),
        (
            [[2, 0, 3], [3, 2.5, 40]],
            [
                "50.0% of the dense points beside the path, 0 where it went",
                "of all beside the path 0.0% over 10 m above the road, 0.0% over .5 m under it",
            ],
        ),
        ([[0, 1.5, 40]], ["no dense point lies beside the path"]),
        ([], ["no dense points"]),
    ],
)
def test_a_share_of_no_points_is_not_printed(
    points: list[list[float]],
    expected: list[str],
    load_script: Callable[[str], ModuleType],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    script = load_script("many_photographs")
    centres = np.array([[0.0, 0, 0], [0, 0, 3], [0, 0.1, 6], [0.2, 0, 9]])
    views = {name: posed(name, centre) for name, centre in zip("abcd", centres, strict=True)}
    images = [
        PosedImage(tmp_path / name, view.camera.matrix, view.rotation, view.translation)
        for name, view in views.items()
    ]
    found = SimpleNamespace(
        views=views,
        centres=centres,
        dense=SimpleNamespace(points=np.array(points, float).reshape(-1, 3)),
        dense_errors=np.full(len(points), 0.5),
    )
    monkeypatch.setattr(script, "reconstruct_many", lambda *_, **__: found)
    monkeypatch.setattr(script, "true_camera", lambda _: views["a"].camera)
    script.show_road(PosedScene("drive", tuple(images), ()), 1.5, tmp_path, 1, False, None)
    printed = capsys.readouterr().out
    lines = printed[printed.index("centres 0 mm (mean), 0 mm (largest)") :].splitlines()[1:]
    assert [line for line in lines if not line.endswith(("(median)", "of the path"))] == expected
