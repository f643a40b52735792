"""Draw the README's animation: a pair whose right image fades from day to dark and back.

python docs/figures/day_to_dark.py    # writes docs/images/day-to-dark.webp

Every frame is matched from scratch. Lines are drawn for a fixed set of keypoints of the left image,
in those frames in which they have a match. The caption gives the number of matches and the share
within 1 px of ground truth. The photographs are the Motorcycle pair of Middlebury 2014 (Scharstein
et al., GCPR 2014; free to use and publish with citation), which comes with scikit-image.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from layout import caption
from PIL import Image

from deepdetect import DeepDetect, match_images
from deepdetect._shared.opencv import cv2
from deepdetect.geometry import disparity_errors
from deepdetect_lab.datasets import StereoPair, load_motorcycle
from deepdetect_lab.datasets.degradation import Degradation, darken, degrade

OUTPUT = Path(__file__).parents[1] / "images" / "day-to-dark.webp"
STEPS, DARKEST = 7, 1 / 8
"""Number of frames from full light to the darkest, and the fraction of the light in the latter."""

LINES, RIGHT_PX = 70, 1.0
"""Number of lines, and the largest error of a correct match in pixels. Chosen by hand."""

CELL = (800, 270)
QUALITY = 62
HOLD_MS, STEP_MS = 1400, 260
"""Duration of the first and the darkest frame, and of the others. Chosen by hand."""


def main() -> None:
    """Write the animation."""
    pair = load_motorcycle()
    lights = np.geomspace(1, DARKEST, STEPS)
    drawn: list[np.ndarray] = []
    chosen = None
    for light in lights:
        frame, chosen = draw(pair, light, chosen)
        drawn.append(frame)
    frames = [Image.fromarray(frame) for frame in drawn + drawn[-2:0:-1]]
    times = [HOLD_MS if k in (0, STEPS - 1) else STEP_MS for k in range(len(frames))]
    frames[0].save(
        OUTPUT, save_all=True, append_images=frames[1:], duration=times, quality=QUALITY, method=6
    )
    print(f"{OUTPUT}: {len(frames)} frames, {OUTPUT.stat().st_size / 1000:.0f} kB")


def draw(
    pair: StereoPair, light: float, chosen: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Darken the right image, match, and draw the lines of the chosen keypoints.

    Returns:
        The frame, and the chosen keypoints (N, 2); if none were given, a sample of this frame.
    """
    darker = Degradation("dark", "", partial(darken, fraction=light))
    right = degrade(pair.right, darker) if light < 1 else pair.right
    matches = match_images(pair.left, right, DeepDetect())
    errors = disparity_errors(matches.points0, matches.points1, pair.disparity)
    known = np.isfinite(errors)
    good = errors[known] < RIGHT_PX
    first, second = matches.points0[known], matches.points1[known]
    if chosen is None:
        chosen = first[np.random.default_rng(4).permutation(len(first))[:LINES]]
    rows = {tuple(xy): k for k, xy in enumerate(first)}
    shown = [rows[tuple(xy)] for xy in chosen if tuple(xy) in rows]
    picture = lines(pair.left, right, first[shown], second[shown], good[shown])
    text = (
        f"right image at {light:.0%} of the light: {len(matches):,} matches, "
        f"{good.mean():.1%} within {RIGHT_PX:g} px of ground truth"
    )
    return caption(picture, text, CELL), chosen


def lines(
    left: np.ndarray, right: np.ndarray, first: np.ndarray, second: np.ndarray, good: np.ndarray
) -> np.ndarray:
    """Draw both images side by side, with a line for each match; wrong ones are red."""
    canvas = np.concatenate([left, right], axis=1)
    hues = np.stack([20 + 120 * first[:, 1] / len(left), *np.full((2, len(first)), 240.0)])
    colors = cv2.cvtColor(np.rint(hues.T).astype(np.uint8)[None], cv2.COLOR_HSV2RGB)[0].tolist()
    for k, color in enumerate(colors):
        color = color if good[k] else (255, 0, 0)
        start = np.rint(first[k]).astype(int).tolist()
        end = np.rint(second[k] + [left.shape[1], 0]).astype(int).tolist()
        cv2.line(canvas, start, end, color, 1, cv2.LINE_AA)
        for place in (start, end):
            cv2.circle(canvas, place, 5, color, -1, cv2.LINE_AA)
    return canvas


if __name__ == "__main__":
    main()
