"""Bundler is in no package index. Where its programs are installed they read the files and map
them; else they are read by the rules of its source: `ReadKeyFile`, `LoadKeys`, `LoadMatchTable`."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepdetect import Camera, Keypoints, OptionError
from deepdetect.interchange import Collection, PairMatches
from deepdetect.interchange.bundler import write_bundler
from deepdetect.sfm.lens import Lens


def read_key_file(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """As Bundler reads Lowe's text: a stream of numbers, whatever the lines are."""
    words = path.read_text().split()
    count, length = int(words[0]), int(words[1])
    table = np.array(words[2:], float).reshape(count, 4 + length)
    return table[:, :4], table[:, 4:]


def test_bundler_reads_what_is_written(small_collection: Collection, tmp_path: Path) -> None:
    lenses = {
        "a.jpg": Lens.of_camera(Camera((120, 110), 99.5)),
        "sub/b.jpg": Lens.initial((120, 110)),
    }
    files = write_bundler(small_collection, tmp_path, lenses=lenses)
    assert {str(path.relative_to(tmp_path)) for path in files} == {
        *("a.key", "sub/b.key", "c.key", "list.txt", "matches.init.txt")
    }
    # A guessed focal length is none.
    assert (tmp_path / "list.txt").read_text() == "a.jpg 0 99.5000\nsub/b.jpg\nc.jpg\n"
    for name, key in (("a.jpg", "a.key"), ("sub/b.jpg", "sub/b.key")):
        points = small_collection.keypoints[name]
        frames, descriptors = read_key_file(tmp_path / key)
        np.testing.assert_allclose(frames[:, 1], points.xy[:, 0], atol=1e-3)
        np.testing.assert_allclose(frames[:, 0], points.xy[:, 1], atol=1e-3)
        np.testing.assert_allclose(frames[:, 2], points.sizes / 2, atol=1e-3)
        turned = (np.degrees(frames[:, 3]) + points.angles + 180) % 360 - 180
        np.testing.assert_allclose(turned, 0, atol=0.02)  # the other way round
        assert np.abs(frames[:, 3]).max() <= np.pi + 1e-3
        np.testing.assert_array_equal(descriptors, points.descriptors)
    words = list(map(int, (tmp_path / "matches.init.txt").read_text().split()))
    assert words == [0, 1, 2, 0, 3, 5, 1, 0, 2, 1, 2, 2]


def test_the_lower_number_is_first(tmp_path: Path) -> None:
    """Bundler passes over matches of a pair the other way round."""
    points = Keypoints(np.eye(4, 2), np.ones(4), (9, 9), descriptors=np.zeros((4, 128), np.uint8))
    first = PairMatches(np.array([[0, 1], [2, 3]]), np.array([0.5, 0.5]))
    turned = PairMatches(np.array([[1, 1], [2, 2]]), np.array([0.6, 0.4]))
    found = {("b.jpg", "c.jpg"): turned, ("b.jpg", "a.jpg"): turned, ("a.jpg", "b.jpg"): first}
    write_bundler(Collection(dict.fromkeys(("a.jpg", "b.jpg", "c.jpg"), points), found), tmp_path)
    words = list(map(int, (tmp_path / "matches.init.txt").read_text().split()))
    # Both ways round are one pair; (2, 2) of the second is less likely than (2, 3) of the first.
    assert words == [0, 1, 2, 1, 1, 2, 3, 1, 2, 2, 1, 1, 2, 2]


def test_the_centre_of_the_image_is_bundlers_origin(tmp_path: Path) -> None:
    """`LoadKeys`: x - (width - 1) / 2, and (height - 1) / 2 - y."""
    descriptors = np.zeros((1, 128), np.uint8)
    middle = Keypoints([[59.5, 54.5]], [1], (120, 110), descriptors=descriptors)
    write_bundler(Collection({"a.jpg": middle}), tmp_path)
    ((row, column, *_),) = read_key_file(tmp_path / "a.key")[0]
    assert (column - 0.5 * (120 - 1), (110 - row - 1) - 0.5 * (110 - 1)) == (0, 0)
    assert not (tmp_path / "matches.init.txt").exists()


@pytest.mark.parametrize(
    ("names", "described", "words"),
    [
        (("a b.jpg",), True, "blanks"),
        (("a.png",), True, "convert a.png"),
        (("a.JPG",), True, "rename"),
        (("a.jpeg",), True, "rename"),
        (("a.jpg", "a.bmp"), True, "the same a.key"),
        (("a.jpg",), False, "SIFT descriptors"),
    ],
)
def test_what_the_format_does_not_hold(
    names: tuple[str, ...], described: bool, words: str, tmp_path: Path, one_line
) -> None:
    descriptors = np.zeros((1, 128), np.uint8) if described else None
    points = Keypoints([[1, 1]], [1], (120, 110), descriptors=descriptors)
    with pytest.raises(OptionError) as caught:
        write_bundler(Collection(dict.fromkeys(names, points)), tmp_path / "out")
    assert words in one_line(caught.value)
    assert not (tmp_path / "out").exists()


def test_photographs_that_exif_turns_are_refused(tmp_path: Path, one_line) -> None:
    """Bundler takes the size from the file, and so would have another centre."""
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (20, 10)).save(tmp_path / "a.jpg", exif=exif)
    points = Keypoints([[1, 1]], [1], (10, 20), descriptors=np.zeros((1, 128), np.uint8))
    collection = Collection({"a.jpg": points}, folder=tmp_path)
    with pytest.raises(OptionError) as caught:
        write_bundler(collection, tmp_path / "out")
    assert "EXIF orientation, which Bundler does not do" in one_line(caught.value)
    assert not (tmp_path / "out").exists()


def bundler_programs() -> tuple[str, str]:
    """Return KeyMatchFull and bundler; Ruby's package manager has the second name, too."""
    matcher = shutil.which("KeyMatchFull")
    program = None if matcher is None else shutil.which("bundler", path=str(Path(matcher).parent))
    if matcher is None or program is None:
        pytest.skip("needs the programs KeyMatchFull and bundler (Bundler, Snavely et al.)")
    return matcher, program


def ran(*words: object, cwd: Path) -> None:
    done = subprocess.run(list(map(str, words)), cwd=cwd, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]


def test_keymatchfull_matches_the_keys(fountain_collection: Collection, tmp_path: Path) -> None:
    """Its nearest neighbours find our matches again."""
    matcher, _ = bundler_programs()
    write_bundler(fountain_collection, tmp_path)
    names = list(fountain_collection.keypoints)
    (tmp_path / "keys.txt").write_text("".join(f"{Path(name).stem}.key\n" for name in names))
    ran(matcher, "keys.txt", "its.txt", cwd=tmp_path)
    words = iter(map(int, (tmp_path / "its.txt").read_text().split()))
    pairs = 0
    for first in words:
        second, count = next(words), next(words)
        theirs = {(next(words), next(words)) for _ in range(count)}
        ours = fountain_collection.matches[names[first], names[second]].rows
        assert len(theirs & set(map(tuple, ours.tolist()))) > 0.8 * count > 9
        pairs += 1
    assert pairs >= 5


def test_bundler_itself_maps_the_files(
    fountain: Path, fountain_collection: Collection, shared: Path, tmp_path: Path
) -> None:
    """Points in its model are where we found them, from the middle and y up; poses are true."""
    from deepdetect.datasets.posed_images import load_posed_scenes

    _, program = bundler_programs()
    size = next(iter(fountain_collection.keypoints.values())).image_size
    lens = Lens.of_camera(Camera(size, 2759.48 * size[0] / 3072))
    names = list(fountain_collection.keypoints)
    # As where the photographs of a pair are named the other way round.
    turned = {
        (name1, name0): PairMatches(found.rows[:, ::-1], found.scores)
        for (name0, name1), found in fountain_collection.matches.items()
    }
    collection = Collection(fountain_collection.keypoints, turned)
    write_bundler(collection, tmp_path, lenses=dict.fromkeys(names, lens))
    for name in names:
        shutil.copy(fountain / name, tmp_path)
    (tmp_path / "bundle").mkdir()
    ran(
        *(program, "list.txt", "--match_table", "matches.init.txt", "--output", "bundle.out"),
        *("--output_dir", "bundle", "--variable_focal_length", "--use_focal_estimate"),
        *("--constrain_focal", "--constrain_focal_weight", "0.0001", "--run_bundle"),
        cwd=tmp_path,
    )
    header, *lines = (tmp_path / "bundle/bundle.out").read_text().splitlines()
    assert header.startswith("# Bundle file v0.3")
    numbers = iter(" ".join(lines).split())
    cameras, points = int(next(numbers)), int(next(numbers))
    assert cameras == 4
    tables = [np.array([float(next(numbers)) for _ in range(15)]).reshape(5, 3) for _ in names]
    assert all(table[0, 0] > 0 for table in tables)  # a focal length: all are registered
    assert points > 300
    seen = []
    for _ in range(points):
        for _ in range(6):  # position and colour
            next(numbers)
        for _ in range(int(next(numbers))):
            seen.append([float(next(numbers)) for _ in range(4)])
    width, height = size
    for camera, key, x, y in seen:
        own = fountain_collection.keypoints[names[int(camera)]].xy[int(key)]
        expected = (own[0] - (width - 1) / 2, (height - 1) / 2 - own[1])
        np.testing.assert_allclose((x, y), expected, atol=2e-3)
    # Its cameras look along -z, and y is up.
    rotations = [np.diag([1, -1, -1]) @ table[1:4] for table in tables]
    (scene,) = load_posed_scenes(shared / "data" / "fountain")
    known = {image.path.name: image.rotation for image in scene.images}
    for name, rotation in zip(names[1:], rotations[1:], strict=True):
        own = rotation @ rotations[0].T
        cosine = (np.trace(own @ (known[name] @ known[names[0]].T).T) - 1) / 2
        assert np.degrees(np.arccos(np.clip(cosine, -1, 1))) < 1
