from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect._shared.options import replace_options
from deepdetect.io.image import luma
from deepdetect.labels import LabelOptions, fuse
from deepdetect.training.batches import Batches
from deepdetect.training.feed import FileFeed
from deepdetect.training.label_cache import LabelCache
from deepdetect.training.photos import list_photos
from deepdetect.training.recipe import Stage, TrainingOptions
from deepdetect.training.schedule import Schedule
from deepdetect.training.view_store import ViewStore
from deepdetect.training.views import render

OPTIONS = TrainingOptions(
    stages=(Stage(64, 4, 6), Stage(96, 2, 1)),
    short_sides=(96, 64),
    flips=True,
    color_jitter=0.0,
    augmentations=1,
    detectors=("fast", "harris", "sobel"),
)


@pytest.fixture(scope="module")
def batches(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> Batches:
    cache = LabelCache(tmp_path_factory.mktemp("labels"), OPTIONS.label_options)
    photos = list_photos(photographs, OPTIONS)
    wanted = [(photo, photo.normal + photo.dark) for photo in photos]
    assert cache.make(wanted, 1, quiet=True) == 12 * 6
    assert cache.make(wanted, 1, quiet=True) == 0, "labels are made once"
    feed = FileFeed(photos, ViewStore(cache), OPTIONS.seed)
    return Batches(feed, Schedule(OPTIONS, len(photos)))


def test_a_batch_is_a_pure_function_of_the_step(batches: Batches) -> None:
    fresh = Batches(batches.feed, batches.schedule)
    for step in (7, 0, 3, 7):
        for ours, theirs in zip(batches.batch(step), fresh.batch(step), strict=True):
            np.testing.assert_array_equal(ours, theirs)
    assert not np.array_equal(batches.batch(0)[0], batches.batch(1)[0])


def test_the_stream_gives_the_same_from_any_step(batches: Batches) -> None:
    whole = [masks.sum() for _, masks in batches.stream(0)]
    assert len(whole) == batches.schedule.steps == 12 * 6 // 4 + 12 // 2
    assert [masks.sum() for _, masks in batches.stream(5)] == whole[5:]


def test_shapes_follow_the_stage(batches: Batches) -> None:
    images, masks = batches.batch(0)
    assert images.shape == (4, 64, 64, 3)
    assert (images.dtype, masks.dtype) == (np.uint8, np.bool_)
    images, masks = batches.batch(batches.schedule.steps - 1)
    assert images.shape == (2, 96, 96, 3)
    assert masks.shape == (2, 96, 96)


def test_each_photograph_is_seen_once_an_epoch(batches: Batches) -> None:
    orders = [[e.photo.path.name for e in batches.feed.epoch(number)] for number in range(3)]
    for order in orders:
        assert len(set(order)) == len(order) == 12
    assert orders[0] != orders[1]
    assert [e.photo.path.name for e in batches.feed.epoch(1, 5)] == orders[1][5:]


def test_about_a_quarter_is_dark(batches: Batches) -> None:
    from deepdetect.labels import visibility_of

    dark = [
        visibility_of(luma(image)) == "low"
        for step in range(18)
        for image in batches.batch(step)[0]
    ]
    assert 0.1 < np.mean(dark) < 0.45


def test_crops_and_labels_belong_together(batches: Batches) -> None:
    """Each crop lies in one of the views, and its mask at the same place of the view's label."""
    photo_views = [
        (render(photo.path, view), batches.feed.store.labels.load(photo, view))
        for photo in batches.feed.photos
        for view in photo.normal + photo.dark
    ]
    images, masks = batches.batch(2)
    for image, mask in zip(images, masks, strict=True):
        assert any(_found(image, mask, *pair) for pair in photo_views)


def _found(image: np.ndarray, mask: np.ndarray, view: np.ndarray, label: np.ndarray) -> bool:
    side = len(image)
    for flipped, flipped_mask in (
        (turned[::a, ::b], turned_mask[::a, ::b])
        for turned, turned_mask in ((image, mask), (image.transpose(1, 0, 2), mask.T))
        for a in (1, -1)
        for b in (1, -1)
    ):
        corner = (view[: len(view) - side + 1, : view.shape[1] - side + 1] == flipped[0, 0]).all(2)
        for top, left in np.argwhere(corner):
            place = np.s_[top : top + side, left : left + side]
            if np.array_equal(view[place], flipped) and np.array_equal(label[place], flipped_mask):
                return True
    return False


def test_mirrors_come_only_when_asked_for(batches: Batches) -> None:
    """Without flips and transpositions each crop is a part of a view as it is."""
    options = replace_options(OPTIONS, flips=False, transpositions=False)
    plain = Batches(batches.feed, Schedule(options, len(batches.feed)))
    views = [
        render(photo.path, view)
        for photo in batches.feed.photos
        for view in photo.normal + photo.dark
    ]
    for image in plain.batch(1)[0]:
        assert any(
            (view[top : top + 64, left : left + 64] == image).all()
            for view in views
            for top, left in np.argwhere((view[:-63, :-63] == image[0, 0]).all(2))
        )


def test_all_mirrors_come_when_asked_for(batches: Batches) -> None:
    """Crops of an image that every mirror changes: each of the eight is seen."""
    options = replace_options(OPTIONS, stages=(Stage(64, 4, 60),), dark_fraction=0.0)

    class Corners:
        """One image for all views, with another value at each corner."""

        photo = batches.feed.photos[0]

        def load(self, view):
            image = np.zeros((64, 64, 3), np.uint8)
            image[0, 0], image[0, -1], image[-1, 0] = 1, 2, 3
            return image, image[..., 0] > 0

    class OneFeed:
        def __len__(self) -> int:
            return 12

        def epoch(self, number, first=0):
            return iter([Corners()] * (12 - first))

    for flips, transpositions, count in ((True, True, 8), (True, False, 4), (False, True, 2)):
        recipe = replace_options(options, flips=flips, transpositions=transpositions)
        seen = set()
        for images, masks in Batches(OneFeed(), Schedule(recipe, 12)).stream(0, 40):
            np.testing.assert_array_equal(masks, images[..., 0] > 0)
            seen |= {tuple(i[[0, 0, -1, -1], [0, -1, 0, -1], 0].tolist()) for i in images}
        assert len(seen) == count


def test_dark_crops_keep_their_luma_to_the_level(batches: Batches) -> None:
    dark = replace_options(OPTIONS, dark_fraction=1.0)
    plain, gray = (
        Batches(
            batches.feed, Schedule(replace_options(dark, color_jitter=share), len(batches.feed))
        )
        for share in (0.0, 1.0)
    )
    for image, other in zip(plain.batch(0)[0], gray.batch(0)[0], strict=True):
        np.testing.assert_array_equal(luma(image), luma(other))
        assert (other == other[..., :1]).all()


def test_colors_change_and_labels_do_not(batches: Batches) -> None:
    options = replace_options(OPTIONS, color_jitter=1.0)
    colored = Batches(batches.feed, Schedule(options, len(batches.feed)))
    gray = 0
    for step in range(4):
        images, masks = batches.batch(step)
        others, same = colored.batch(step)
        np.testing.assert_array_equal(masks, same)
        for image, other in zip(images, others, strict=True):
            assert np.abs(luma(other).astype(int) - luma(image)).max() <= 1
            gray += (other == other[..., :1]).all()
    assert 4 < gray < 16


def test_dark_labels_use_the_low_visibility_settings(batches: Batches) -> None:
    photo = batches.feed.photos[0]
    view = photo.dark[0]
    expected = fuse(luma(render(photo.path, view)), LabelOptions(OPTIONS.detectors, "low"))
    np.testing.assert_array_equal(batches.feed.store.labels.load(photo, view), expected.mask)


def test_an_error_of_the_thread_reaches_the_trainer(batches: Batches) -> None:
    class Broken(ViewStore):
        def load(self, photo, view):
            raise ValueError("broken on purpose")

    store = Broken(batches.feed.store.labels)
    broken = Batches(FileFeed(batches.feed.photos, store, 0), batches.schedule)
    with pytest.raises(ValueError, match="on purpose"):
        next(broken.stream(0))


def test_memory_limit_changes_nothing_but_the_time(batches: Batches) -> None:
    store = ViewStore(batches.feed.store.labels, memory=0)
    frugal = Batches(FileFeed(batches.feed.photos, store, OPTIONS.seed), batches.schedule)
    np.testing.assert_array_equal(frugal.batch(4)[0], batches.batch(4)[0])
    assert not store._kept


def test_a_stage_can_take_some_views_only(batches: Batches) -> None:
    options = replace_options(OPTIONS, stages=(Stage(64, 12, 1, sides=(64,)),))
    small = Batches(batches.feed, Schedule(options, len(batches.feed)))
    views = [
        render(photo.path, view)
        for photo in batches.feed.photos
        for view in photo.normal + photo.dark
        if view.short_side == 64
    ]
    images, masks = small.batch(0)
    for image, mask in zip(images, masks, strict=True):
        assert mask.shape == (64, 64)
        assert any(_inside(image, view) for view in views)


def _inside(image: np.ndarray, view: np.ndarray) -> bool:
    """Whether a mirrored crop is part of a view."""
    side = len(image)
    turned = (image, image.transpose(1, 0, 2))
    flipped = [each[::a, ::b] for each in turned for a in (1, -1) for b in (1, -1)]
    return any(
        np.array_equal(view[:side, left : left + side], crop)
        for crop in flipped
        for left in range(view.shape[1] - side + 1)
    )


def test_interleaved_batches_are_those_of_the_stages_in_turn(batches: Batches) -> None:
    schedule = Schedule(replace_options(OPTIONS, interleave=True), len(batches.feed))
    mixed = Batches(batches.feed, schedule)
    sums = sorted(int(images.sum()) for images, _ in mixed.stream(0))
    assert sums == sorted(int(images.sum()) for images, _ in batches.stream(0))
    sizes = [len(masks[0]) for _, masks in mixed.stream(0)]
    assert set(sizes[:6]) == set(sizes[-6:]) == {64, 96}
    for (ours, _), (theirs, _) in zip(mixed.stream(9), list(mixed.stream(0))[9:], strict=True):
        np.testing.assert_array_equal(ours, theirs)
