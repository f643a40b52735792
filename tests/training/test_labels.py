from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetectError
from deepdetect.io.image import luma
from deepdetect.labels import LabelOptions, fuse
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
def cache(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> LabelCache:
    made = LabelCache(tmp_path_factory.mktemp("labels"), OPTIONS.labels)
    wanted = [(image, image.normal + image.dark) for image in list_images(photographs, OPTIONS)]
    assert made.make(wanted[:3], workers=1) == 3 * 4
    assert made.make(wanted[:4], workers=1) == 4, "labels are made once"
    return made


def test_labels_are_those_of_the_views(cache: LabelCache, photographs: Path) -> None:
    image = list_images(photographs, OPTIONS)[0]
    for view in image.normal + image.dark:
        rgb = render(image.path, view)
        visibility = "normal" if view.darkening is None else "low"
        expected = fuse(luma(rgb), LabelOptions(OPTIONS.labels.detectors, visibility)).mask
        np.testing.assert_array_equal(cache.load(image, view), expected)


def test_a_view_of_an_array_has_the_same_label(cache: LabelCache, photographs: Path) -> None:
    from deepdetect import load_image

    image = list_images(photographs, OPTIONS)[1]
    for view in image.normal + image.dark:
        made = label_view(load_image(image.path), view, OPTIONS.labels)
        np.testing.assert_array_equal(made, cache.load(image, view))


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
        cache.make([(image, image.normal) for image in images], workers=1)
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


def test_a_replaced_photograph_gets_a_new_label(photographs: Path, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    cache = LabelCache(tmp_path / "labels", LabelOptions(("fast",)))
    paths = []
    for source in ("photo00.png", "photo01.png"):
        (folder / "a.png").write_bytes((photographs / source).read_bytes())
        (image,) = list_images(folder, OPTIONS)
        paths.append(cache.path(image, image.normal[0]))
    assert paths[0] != paths[1]
