from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetectError
from deepdetect.io.image import luma
from deepdetect.labels import LabelOptions, fuse
from deepdetect.training.dataset import FolderSource
from deepdetect.training.labels import LabelCache, label_view, settings_digest
from deepdetect.training.recipe import Stage, TrainingOptions
from deepdetect.training.views import digest_images, list_images, render

OPTIONS = TrainingOptions(
    stages=(Stage(64, 2, 1),),
    short_sides=(64,),
    augmentations=1,
    labels=LabelOptions(("fast", "sobel")),
)


@pytest.fixture(scope="module")
def source(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> FolderSource:
    cache = LabelCache(tmp_path_factory.mktemp("labels"), OPTIONS.labels)
    images = list_images(photographs, OPTIONS)
    for count, expected in ((3, 3 * 4), (4, 4)):
        made = FolderSource(images[:count], cache)
        views = [image.normal + image.dark for image in made.images]
        assert made.make_labels(views, workers=1) == expected, "labels are made once"
    return made


def test_labels_are_those_of_the_views(source: FolderSource) -> None:
    image = source.images[0]
    for view in image.normal + image.dark:
        rgb = render(image.path, view)
        visibility = "normal" if view.darkening is None else "low"
        expected = fuse(luma(rgb), LabelOptions(OPTIONS.labels.detectors, visibility)).mask
        np.testing.assert_array_equal(source.labels.load(image, view), expected)
        np.testing.assert_array_equal(label_view(rgb, view, OPTIONS.labels), expected)


def test_other_settings_have_another_folder() -> None:
    digests = {settings_digest(LabelOptions(names)) for names in (("fast",), ("fast", "sobel"))}
    assert len(digests) == 2
    assert settings_digest(LabelOptions(("fast",), "low")) in digests, "views decide that"


def test_an_image_that_cannot_be_read_is_named(photographs: Path, tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes((photographs / "photo00.png").read_bytes())
    (tmp_path / "broken.png").write_bytes(b"no image")
    images = list_images(tmp_path, OPTIONS)
    cache = LabelCache(tmp_path / "labels", OPTIONS.labels)
    with pytest.raises(DeepDetectError, match=r"1 of 3 images cannot be read.*broken\.png"):
        FolderSource(images, cache).make_labels([image.normal for image in images], workers=1)
    assert len(list(cache.folder.glob("*.png"))) == 2 * 2, "the others are kept"


def test_photographs_of_one_name_have_their_own_labels(photographs: Path, tmp_path: Path) -> None:
    """Training and validation folders often number their photographs in the same way."""
    for part, source in (("train", "photo00.png"), ("val", "photo05.png")):
        (tmp_path / part).mkdir()
        (tmp_path / part / "0001.png").write_bytes((photographs / source).read_bytes())
    cache = LabelCache(tmp_path / "labels", LabelOptions(("fast",)))
    (first,), (second,) = (list_images(tmp_path / part, OPTIONS) for part in ("train", "val"))
    assert cache.path(first, first.normal[0]) != cache.path(second, second.normal[0])
    assert digest_images([first], [second]) != digest_images([second], [first])
