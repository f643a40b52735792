from __future__ import annotations

from pathlib import Path

import pytest

from deepdetect._shared.errors import ImageError
from deepdetect.labels import LabelOptions
from deepdetect.training.label_cache import LabelCache
from deepdetect.training.photos import Photo, list_photos, photos_digest, train_val_split
from deepdetect.training.recipe import Stage, TrainingOptions

OPTIONS = TrainingOptions(stages=(Stage(64, 2, 1),), short_sides=(96, 64), dark_variants=2)


def photos(count: int) -> list[Photo]:
    return [Photo(Path(f"photo{k}.jpg"), f"{k:08x}", (), ()) for k in range(count)]


def test_views_are_all_sizes_in_both_lights(photographs: Path) -> None:
    listed = list_photos(photographs, OPTIONS)
    assert len(listed) == 12
    for photo in listed:
        assert [view.short_side for view in photo.normal] == [96, 64]
        assert [view.short_side for view in photo.dark] == [96, 96, 64, 64]
        assert all(view.darkening is None for view in photo.normal)
        assert len({view.name for view in photo.normal + photo.dark}) == 6
    assert list_photos(photographs, OPTIONS) == listed, "the same on every call"


def test_one_in_twenty_is_held_out_and_nothing_is_in_both() -> None:
    kept, held = train_val_split(photos(4000))
    assert 150 < len(held) < 250
    assert len(kept) + len(held) == 4000
    assert not {photo.path for photo in kept} & {photo.path for photo in held}


def test_photographs_keep_their_side_when_others_come() -> None:
    _, before = train_val_split(photos(500))
    _, after = train_val_split(photos(1000))
    assert {photo.path for photo in before} <= {photo.path for photo in after}


def test_few_photographs_still_give_one_for_validation() -> None:
    kept, held = train_val_split(photos(2))
    assert (len(kept), len(held)) == (1, 1)
    with pytest.raises(ImageError, match="too few"):
        train_val_split(photos(1))


def test_photographs_of_one_name_have_their_own_labels(photographs: Path, tmp_path: Path) -> None:
    """Training and validation folders often number their photographs alike."""
    for part, source in (("train", "photo00.png"), ("val", "photo05.png")):
        (tmp_path / part).mkdir()
        (tmp_path / part / "0001.png").write_bytes((photographs / source).read_bytes())
    cache = LabelCache(tmp_path / "labels", LabelOptions(("fast",)))
    (first,), (second,) = (list_photos(tmp_path / part, OPTIONS) for part in ("train", "val"))
    assert cache.path(first, first.normal[0]) != cache.path(second, second.normal[0])
    assert photos_digest([first], [second]) != photos_digest([second], [first])


def test_a_replaced_photograph_gets_a_new_label(photographs: Path, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    cache = LabelCache(tmp_path / "labels", LabelOptions(("fast",)))
    paths = []
    for source in ("photo00.png", "photo01.png"):
        (folder / "a.png").write_bytes((photographs / source).read_bytes())
        (photo,) = list_photos(folder, OPTIONS)
        paths.append(cache.path(photo, photo.normal[0]))
    assert paths[0] != paths[1]


def test_results_below_the_photographs_are_left_out(photographs: Path, tmp_path: Path) -> None:
    (tmp_path / "run" / "labels").mkdir(parents=True)
    for place in ("a.png", "run/curves.png", "run/labels/b.png"):
        (tmp_path / place).write_bytes((photographs / "photo00.png").read_bytes())
    listed = list_photos(tmp_path, OPTIONS, exclude=(tmp_path / "run",))
    assert [photo.path.name for photo in listed] == ["a.png"]
