"""Arrays of all types and shapes, drawn by hypothesis."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
from hypothesis import strategies
from hypothesis.extra import numpy as arrays
from hypothesis.strategies import SearchStrategy

from deepdetect import DeepDetect, Keypoints, PointDetector, load_image, match_images

from ..case import Target, expect, prepared

SIDES = (0, 1, 3, 4, 15, 16, 17, 40)
TYPES = "uint8 uint16 >u2 int8 int16 int32 int64 uint32 float16 float32 float64 bool complex64 U3 O"


def draw(strategy: SearchStrategy[Any], generator: np.random.Generator) -> Any:
    """Draw one value, the same for the same state of the generator."""
    found: list[Any] = []

    @hypothesis.seed(int(generator.integers(2**32)))
    @hypothesis.settings(
        max_examples=4,
        database=None,
        deadline=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(strategy)
    def take(value: Any) -> None:
        found.append(value)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        take()
    return found[-1]  # the first ones are the simplest


SHAPES = strategies.one_of(
    strategies.tuples(strategies.sampled_from((16, 17, 40)), strategies.sampled_from((16, 30))),
    strategies.tuples(
        *[strategies.sampled_from((16, 17, 40))] * 2, strategies.sampled_from((0, 1, 2, 3, 4, 5))
    ),
    strategies.lists(strategies.sampled_from(SIDES), max_size=4).map(tuple),
)
ROUNDING = 1.02
"""Grey levels: colours are rounded, then they are blended with grey and rounded again."""

IN_RANGE = strategies.floats(0, 1, width=16)


@strategies.composite
def any_array(draw_value: Any) -> np.ndarray:
    """Draw an array of any type and shape; floats often in [0, 1]."""
    kind = np.dtype(draw_value(strategies.sampled_from(TYPES.split())))
    shape = draw_value(SHAPES)
    if kind.kind == "O":
        return np.full(shape, None)
    elements = IN_RANGE if kind.kind == "f" and draw_value(strategies.booleans()) else None
    found: np.ndarray = draw_value(arrays.arrays(kind, shape, elements=elements))
    return found


def loaded(generator: np.random.Generator, folder: Path) -> None:
    """Load an array; the stated contract says what comes of it."""
    array = draw(any_array(), generator)
    found = load_image(array)  # refused: one sentence
    array = channels_last(array)
    allowed = is_allowed(array)
    expect(allowed, f"{array.dtype} of shape {array.shape} was taken")
    expect(found.dtype == np.uint8, f"of type {found.dtype}")
    levels = {"u1": [1.0], "u2": [255 / white for white in whites(array)]}
    scales = levels.get(array.dtype.str[1:], [255.0])
    fits = any(np.abs(found - shown(array, scale)).max() <= ROUNDING for scale in scales)
    expect(fits, f"pixels of {array.dtype} of shape {array.shape} are wrong")


def shown(array: np.ndarray, scale: float) -> np.ndarray:
    """Return the grey levels of an image; what is less than half opaque is grey alone."""
    array = array if array.ndim == 3 else array[:, :, None]
    colours = (array[:, :, :3].astype(np.float64) * scale).clip(0, 255)
    if array.shape[2] < 4:
        return colours
    alpha = array[:, :, 3]
    share = alpha / (255 if alpha.dtype == np.uint8 else max(int(alpha.max()), 1))
    if (share < 0.5).all():
        return colours  # the channel says nothing
    share = np.where(share < 0.5, 0, share)[:, :, None]
    return np.asarray(colours * share + 128 * (1 - share))


def whites(array: np.ndarray) -> list[int]:
    """Return what may be white in an image whose depth nothing says, but for some hot pixels."""
    values = array[:, :, :3] if array.ndim == 3 else array
    values = values[values < 65535]  # may be padding
    candidates = [2**bits - 1 for bits in (8, 10, 12, 14, 16)]
    return [white for white in candidates if np.count_nonzero(values > white) <= 2]


def channels_last(array: np.ndarray) -> np.ndarray:
    """Return an image with its channels last, wherever they are."""
    first = array.ndim == 3 and array.shape[0] in (1, 3, 4) and array.shape[2] not in (1, 3, 4)
    return array.transpose(1, 2, 0) if first else array


def is_allowed(array: np.ndarray) -> bool:
    """Whether `load_image` says that it takes an array with its channels last."""
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] not in (1, 3, 4)):
        return False
    if min(array.shape[:2]) < 16:
        return False
    if array.dtype.kind == "f":
        return bool(np.isfinite(array).all() and array.min() >= 0 and array.max() <= 1)
    return array.dtype.kind == "b" or array.dtype.str[1:] in ("u1", "u2")


@prepared
def detector() -> DeepDetect:
    """Return the detector of all inputs."""
    return DeepDetect()


def detected(generator: np.random.Generator, folder: Path) -> None:
    """Detect keypoints in an array, dense or points."""
    array = draw(any_array(), generator)
    budget = [None, 1, 50][int(generator.integers(3))]
    chosen = detector() if budget is None else PointDetector(budget)
    if array.ndim == 4:  # a batch
        found = chosen.detect_batch(array)
        expect(len(found) == len(array), f"{len(found)} results for {array.shape}")
        for image, keypoints in zip(array, found, strict=True):
            check_keypoints(image, keypoints, budget)
    else:
        check_keypoints(array, chosen.detect(array), budget)


def check_keypoints(image: np.ndarray, found: Keypoints, budget: int | None) -> None:
    """Check what was found in an image."""
    image = channels_last(image)
    expect(is_allowed(image), f"{image.dtype} of shape {image.shape} was taken")
    height, width = image.shape[:2]
    expect(found.image_size == (width, height), f"of an image of {found.image_size}")
    expect(np.isfinite(found.xy).all() and np.isfinite(found.scores).all(), "not finite")
    inside = (found.xy > -0.51) & (found.xy < np.array([width, height]) - 0.49)
    expect(inside.all(), "keypoints outside the image")
    expect(((found.scores >= 0) & (found.scores <= 1)).all(), "scores are no probabilities")
    expect(budget is None or len(found) <= budget, "more keypoints than asked for")


def matched(generator: np.random.Generator, folder: Path) -> None:
    """Match two arrays."""
    first, second = (draw(any_array(), generator) for _ in range(2))
    if generator.random() < 0.5:  # a pair that has matches
        first = np.kron(generator.integers(0, 256, (20, 24)), np.ones((4, 4))).astype(np.uint8)
        second = np.roll(first, 3, axis=1)
    chosen = [detector(), PointDetector(100)][int(generator.integers(2))]
    found = match_images(first, second, chosen)
    expect(len(found.points0) == len(found.points1) == len(found.inliers), "rows do not fit")
    expect(np.isfinite(found.points0).all() and np.isfinite(found.points1).all(), "not finite")


TARGETS = (
    Target("arrays", "arrays, load_image", loaded, 3000, 500),
    Target("arrays-detect", "arrays, detect", detected, 800, 200),
    Target("arrays-match", "arrays, match_images", matched, 200, 50),
)
