from __future__ import annotations

from pathlib import Path

import pytest

from deepdetect.errors import ImageError
from deepdetect.training.photos import Photo, hold_out, list_photos
from deepdetect.training.recipe import Stage, TrainingOptions

OPTIONS = TrainingOptions(stages=(Stage(64, 2, 1),), short_sides=(96, 64), dark_variants=2)


def photos(count: int) -> list[Photo]:
    return [Photo(Path(f"photo{k}.jpg"), (), ()) for k in range(count)]


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
    kept, held = hold_out(photos(4000))
    assert 150 < len(held) < 250
    assert len(kept) + len(held) == 4000
    assert not {photo.path for photo in kept} & {photo.path for photo in held}


def test_photographs_keep_their_side_when_others_come() -> None:
    _, before = hold_out(photos(500))
    _, after = hold_out(photos(1000))
    assert {photo.path for photo in before} <= {photo.path for photo in after}


def test_few_photographs_still_give_one_for_validation() -> None:
    kept, held = hold_out(photos(2))
    assert (len(kept), len(held)) == (1, 1)
    with pytest.raises(ImageError, match="too few"):
        hold_out(photos(1))
