"""The self-test of `deepdetect doctor`: two small pictures with a known answer."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from ._findings import Finding, as_sentence

if TYPE_CHECKING:
    import numpy as np

    from ..features.matches import Matches

PICTURE_SIZE = (320, 240)
SHIFT_PX = (6, 4)
"""What the second picture is moved by, (x, y)."""

MIN_PRECISION = 0.95
"""Of the matches within 1 px of the shift; all of them are where nothing is wrong."""


def run_self_test() -> Iterator[Finding]:
    """Detect and match two pictures whose shift is known."""
    import numpy as np

    from .._shared.kernels import has_compiler
    from ..detector.detector import DeepDetect
    from ..matching.pipeline import match_images

    seconds: dict[str, float] = {}

    def timed(stage: str, work: Callable[[], Any]) -> Any:
        start = time.perf_counter()
        result = work()
        seconds[stage] = round(time.perf_counter() - start, 3)
        return result

    width, height = PICTURE_SIZE
    right, down = SHIFT_PX
    whole = textured_picture((width + right, height + down))
    whole[: height // 4] = 128  # nothing to be found there
    first, second = whole[:height, :width], whole[down:, right:]
    try:
        detector = timed("load the network", DeepDetect)
        dense = timed("dense keypoints", lambda: detector.detect(first))
        points = timed("256 points", lambda: detector.detect(first, max_keypoints=256))
        guided = has_compiler()

        def match() -> Matches:
            return match_images(first, second, detector, guided=guided, mutual=not guided)

        if guided:
            timed("guided matching, the first time", match)  # may compile
        matches = timed("guided matching" if guided else "matching by descriptors", match)
    except Exception as error:  # whatever is wrong here, the others are to be reported, too
        yield Finding("self-test", "problem", "failed", as_sentence(error), {"seconds": seconds})
        return
    in_flat = (dense.xy[:, 1] < height // 4 - 16).mean() if len(dense) else 1.0
    errors = matches.points0 - matches.points1 - np.array([right, down])
    precision = float((np.hypot(*errors.T) < 1).mean()) if len(matches) else 0.0
    details = {
        "seconds": seconds,
        "dense_keypoints": len(dense),
        "points": len(points),
        "matches": len(matches),
        "precision": precision,
        "guided": guided,
    }
    value = (
        f"{len(dense):,} dense keypoints, {len(points)} points, {len(matches):,} matches, "
        f"{precision:.1%} of them right"
    )
    lowest = MIN_PRECISION if guided else MIN_PRECISION / 2
    right_answer = len(dense) > 5_000 and in_flat < 0.01 and precision >= lowest
    if right_answer and len(points) > 100:
        yield Finding("self-test", "ok", value, details=details)
        for stage, taken in seconds.items():
            yield Finding(f"seconds: {stage}", "ok", f"{taken:.3f}")
        return
    yield Finding(
        "self-test",
        "problem",
        f"wrong results: {value}",
        "Try --backend of another name, and report this with what `deepdetect doctor --json` "
        "prints.",
        details,
    )


def textured_picture(size: tuple[int, int]) -> np.ndarray:
    """Draw a picture, (H, W, 3) uint8, the same every time: soft noise, which is structure."""
    import numpy as np

    width, height = size
    # Linear interpolation by hand: OpenCV may be what is broken.
    coarse = np.random.default_rng(0).random((height // 4 + 2, width // 4 + 2, 3))
    y, x = np.arange(height) / 4, np.arange(width) / 4
    row, column = y.astype(int), x.astype(int)
    down, right = (y - row)[:, None, None], (x - column)[None, :, None]
    above = coarse[row][:, column] * (1 - right) + coarse[row][:, column + 1] * right
    below = coarse[row + 1][:, column] * (1 - right) + coarse[row + 1][:, column + 1] * right
    picture: np.ndarray = np.rint(255 * (above * (1 - down) + below * down)).astype(np.uint8)
    return picture
