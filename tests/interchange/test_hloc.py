"""hloc is not on PyPI. Where it is installed, it reads the files itself, and maps them. Else they
are read by the rules of its source (`utils/io.py`, `triangulation.py`), and mapped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("h5py", reason="needs h5py")

from deepdetect import Keypoints, OptionError
from deepdetect.interchange import Collection, PairMatches, read_collection
from deepdetect.interchange.hloc import write_hloc


def hloc_keypoints(path: Path, name: str) -> np.ndarray:
    """As `hloc.utils.io.get_keypoints`."""
    import h5py

    with h5py.File(str(path), "r", libver="latest") as file:
        return file[name]["keypoints"].__array__()


def hloc_matches(path: Path, name0: str, name1: str) -> tuple[np.ndarray, np.ndarray]:
    """As `hloc.utils.io.get_matches` with `find_pair`, which looks both ways round."""
    import h5py

    def group(first: str, second: str) -> str:
        return "/".join((first.replace("/", "-"), second.replace("/", "-")))

    with h5py.File(str(path), "r", libver="latest") as file:
        reverse = group(name0, name1) not in file
        pair = group(name1, name0) if reverse else group(name0, name1)
        matches = file[pair]["matches0"].__array__()
        scores = file[pair]["matching_scores0"].__array__()
    rows = np.where(matches != -1)[0]
    matches = np.stack([rows, matches[rows]], -1)
    return (np.flip(matches, -1) if reverse else matches), scores[rows]


def test_hloc_reads_what_is_written(small_collection: Collection, tmp_path: Path) -> None:
    import h5py

    features, matches, pairs = write_hloc(small_collection, tmp_path)
    for name, points in small_collection.keypoints.items():
        np.testing.assert_array_equal(hloc_keypoints(features, name), points.xy)
    with h5py.File(features) as file:
        group = file["sub/b.jpg"]
        points = small_collection.keypoints["sub/b.jpg"]
        assert group["descriptors"].shape == (128, 6)
        np.testing.assert_allclose(np.linalg.norm(group["descriptors"], axis=0), 1, rtol=1e-6)
        for kind in ("keypoints", "scores", "descriptors"):
            assert group[kind].dtype == np.float32
        assert group["image_size"][()].tolist() == [120, 110]
        assert group["keypoints"].attrs["uncertainty"] == 1
        np.testing.assert_allclose(group["scales"], points.sizes / 2)
        np.testing.assert_allclose(group["oris"], points.angles)
    for (name0, name1), expected in small_collection.matches.items():
        rows, scores = hloc_matches(matches, name0, name1)
        np.testing.assert_array_equal(rows, expected.rows)
        np.testing.assert_allclose(scores, expected.scores)
        np.testing.assert_array_equal(
            hloc_matches(matches, name1, name0)[0], expected.rows[:, ::-1]
        )
    assert pairs.read_text() == "a.jpg sub/b.jpg\nc.jpg a.jpg\n"


def test_more_keypoints_than_int16_holds(tmp_path: Path) -> None:
    points = Keypoints(
        np.random.default_rng(0).uniform(0, 4000, (40_000, 2)), np.ones(40_000), (4000, 4000)
    )
    many = Collection(
        {"a": points, "b": points},
        {("a", "b"): PairMatches(np.array([[39_999, 39_998]]), np.ones(1))},
    )
    features, matches, _ = write_hloc(many, tmp_path)
    assert hloc_matches(matches, "a", "b")[0].tolist() == [[39_999, 39_998]]
    np.testing.assert_array_equal(hloc_keypoints(features, "a"), points.xy)  # no half precision


def test_two_pairs_of_one_group_are_refused(tmp_path: Path) -> None:
    points = Keypoints([[1, 1]], [1], (8, 8))
    match = PairMatches(np.array([[0, 0]]), np.ones(1))
    twice = Collection(
        dict.fromkeys(("a/b", "a-b", "c"), points), {("a/b", "c"): match, ("a-b", "c"): match}
    )
    with pytest.raises(OptionError):
        write_hloc(twice, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.filterwarnings("ignore")  # of its own
def test_hloc_itself_maps_the_files(fountain, fountain_collection, tmp_path: Path) -> None:
    """`reconstruction`, and `triangulation` with the poses that it has found."""
    pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap: pip install '.[sfm]'")
    pytest.importorskip("hloc", reason="needs hloc, which is not on PyPI")
    from hloc import reconstruction, triangulation

    features, matches, pairs = write_hloc(fountain_collection, tmp_path / "hloc")
    size = next(iter(fountain_collection.keypoints.values())).image_size
    model = reconstruction.main(
        tmp_path / "sfm",
        fountain,
        pairs,
        features,
        matches,
        camera_mode=pycolmap.CameraMode.SINGLE,
        image_options={
            "camera_model": "SIMPLE_PINHOLE",
            "camera_params": f"{2759.48 * size[0] / 3072},{size[0] / 2},{size[1] / 2}",
        },
        mapper_options={"min_model_size": 3, "random_seed": 0, "num_threads": 1},
    )
    assert model.num_reg_images() == 4
    assert model.num_points3D() > 300
    assert model.compute_mean_reprojection_error() < 1
    with pycolmap.Database.open(tmp_path / "sfm" / "database.db") as database:
        for image in database.read_all_images():
            expected = fountain_collection.keypoints[image.name].xy + 0.5
            np.testing.assert_array_equal(database.read_keypoints(image.image_id)[:, :2], expected)
    again = triangulation.main(
        tmp_path / "triangulated",
        tmp_path / "sfm",
        fountain,
        pairs,
        features,
        matches,
        # COLMAP 4 passes over the geometries that hloc 1.5 writes itself: they have no kind.
        estimate_two_view_geometries=True,
    )
    assert again.num_points3D() > 300
    assert again.compute_mean_reprojection_error() < 1


def test_keypoints_without_an_angle_stay_without_one(tmp_path: Path) -> None:
    """OpenCV's -1 is no angle, and not 359 degrees."""
    points = Keypoints([[3, 4], [5, 6]], [1, 1], (20, 10), sizes=[3, 3], angles=[-1, 90])
    path, *_ = write_hloc(Collection({"a.jpg": points}), tmp_path)
    assert read_collection([path]).keypoints["a.jpg"].angles.tolist() == [-1, 90]
