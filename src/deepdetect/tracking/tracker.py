"""Track points from frame to frame by pyramidal Lucas-Kanade.

Lucas and Kanade, "An iterative image registration technique", 1981, with Bouguet's pyramid. Each
point is followed to the next frame and back, and dropped if it does not come back to where it was
(Kalal et al., "Forward-backward error", 2010). Kept points are aligned with the patch around their
first position, under an affine deformation, so that errors hardly add up (Shi and Tomasi, "Good
features to track", 1994). The best keypoints that are far enough from all tracks begin new tracks.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from .._shared.errors import OptionError
from .._shared.image_array import Channels
from .._shared.opencv import cv2
from .._shared.options import check_ranges, suggest_keywords
from ..features.keypoints import Keypoints
from ..geometry.alignment import Alignment, align_patches
from ..geometry.images import gaussian_blur, track_round_trip
from ..io.image import at_pixels, load_visible, luma
from .tracks import TrackedFrame

Detect = Callable[[np.ndarray], Keypoints]
"""A function that returns the keypoints of a (H, W, 3) uint8 RGB image."""

CANDIDATES = 3
"""The detector finds this many keypoints per track, so that enough are far from existing tracks."""

MIN_DISTANCE_PX, MIN_SPACING = 8.0, 0.35
"""A new point is farther from all tracks than MIN_DISTANCE_PX and than MIN_SPACING times the
spacing of a regular grid of `max_keypoints` points, so that points cover the whole image."""

WINDOW_PX, LEVELS = 21, 3
"""Side of the patch that is followed, and number of pyramid levels above the image. Each level
doubles how far points may move between frames. Both numbers are OpenCV's defaults."""

BORDER_PX = 2.0
"""Points nearer than this to the image border are dropped. Chosen by hand."""

ALIGNMENT = Alignment(radius_px=10, max_shift_px=3.0, convergence_px=0.03, affine=True)
"""How patches are aligned. Tracking by translation alone can be wrong by up to 3 pixels where
surfaces come nearer. Chosen by hand."""

KEPT_PX = ALIGNMENT.radius_px + 3
"""A patch is kept with 3 more pixels on each side, which interpolation reads."""

BLUR_SIGMA_PX = 1.0
"""Images are blurred with this sigma, so that values between pixels can be interpolated well."""

MAX_GROWTH = 4.0
"""The area of a patch may grow or shrink by at most this factor, because otherwise one image shows
the patch on too few pixels. Chosen by hand."""

MOST_READ = 1 << 14
"""OpenCV limits the sides of images to 32,767 px, so at most this many patches are read at once."""


@suggest_keywords
@dataclass(frozen=True)
class TrackingOptions:
    """How points are followed.

    Attributes:
        max_keypoints: largest number of tracks at a time.
        detect_every: detect new points after this many frames, or earlier if many tracks are lost.
        min_kept: detect new points early if less than this fraction of the tracks after the last
            detection is left.
        max_return_error_px: drop a point if, followed to the next frame and back, it ends more
            than this many pixels from its start.

    Raises:
        OptionError: a value is out of its range.
    """

    max_keypoints: int = 1000
    detect_every: int = 5
    min_kept: float = 0.4
    max_return_error_px: float = 0.5

    def __post_init__(self) -> None:
        check_ranges(
            self,
            counts=("max_keypoints", "detect_every"),
            not_negative=("max_return_error_px",),
            fractions=("min_kept",),
        )


class Tracker:
    """Follows points through the frames of a video.

    Args:
        detect: detects keypoints in a (H, W, 3) uint8 RGB image, as `PointDetector().detect` does.
        options: how points are followed.
        ignore: (H, W) bool mask, true where no point is kept; larger masks are scaled down.

    Example:
        >>> grid = np.stack(np.meshgrid(range(10, 90, 10), range(10, 60, 10)), -1).reshape(-1, 2)
        >>> detect = lambda rgb: Keypoints(grid, np.ones(len(grid)), (96, 64))
        >>> rgb = np.random.default_rng(0).integers(0, 256, (64, 96, 3), np.uint8)
        >>> rgb = cv2.GaussianBlur(rgb, None, 2)
        >>> tracker = Tracker(detect)
        >>> first, second = tracker.update(rgb), tracker.update(np.roll(rgb, 3, axis=1))
        >>> len(first), np.abs(second.xy[0] - first.xy[0]).round(1).tolist()
        (40, [3.0, 0.0])
    """

    def __init__(
        self,
        detect: Detect,
        options: TrackingOptions = TrackingOptions(),
        ignore: np.ndarray | None = None,
    ) -> None:
        self.detect, self.options, self.ignore = detect, options, ignore
        self._gray: np.ndarray | None = None
        self._frames = self._since_detection = self._next_track = 0
        self._most = 0  # number of tracks after the last detection
        self._points: dict[str, np.ndarray] = {
            "tracks": np.empty(0, np.int64),
            "xy": np.empty((0, 2), np.float32),
            "scores": np.empty(0, np.float32),
            "ages": np.empty(0, np.int64),
        }
        side = 2 * KEPT_PX + 1
        self._patches = Patches(np.empty((0, side, side), np.float32), np.empty((0, 2, 2)))

    @suggest_keywords
    def update(
        self, image: Any, *, number: int | None = None, channels: Channels = "rgb"
    ) -> TrackedFrame:
        """Follow all points into the next frame, and begin new tracks when the options say so.

        Args:
            image: an image as for `DeepDetect.detect`, of the same size as earlier frames.
            number: number of the frame; None: frames are counted from 0.
            channels: order of the colours.

        Raises:
            ImageError: the image cannot be read or used.
            OptionError: the image differs in size from earlier frames.
        """
        rgb, hidden = load_visible(image, channels)
        options, gray = self.options, luma(rgb)
        if self._gray is not None:
            if self._gray.shape != gray.shape:
                (height, width), (before_height, before_width) = gray.shape, self._gray.shape
                raise OptionError(
                    f"a frame has {width}x{height} pixels, but earlier frames have "
                    f"{before_width}x{before_height}: use one tracker for each size"
                )
            self._follow(self._gray, gray, hidden)
        image = gaussian_blur(gray, BLUR_SIGMA_PX)
        self._return_to_patches(image)
        count = len(self._points["xy"])
        if (
            not count
            or self._since_detection >= options.detect_every
            or count < options.min_kept * self._most
        ):
            keypoints = self.detect(rgb)
            self._add(keypoints[~at_pixels(hidden, keypoints.xy)], image)
            self._most = len(self._points["xy"])
            self._since_detection = 0
        self._drop_ignored(gray.shape)
        self._since_detection += 1
        self._gray = gray
        copies = {name: values.copy() for name, values in self._points.items()}
        found = TrackedFrame(self._frames if number is None else number, **copies)
        self._points["ages"] += 1
        self._frames += 1
        return found

    def _follow(self, before: np.ndarray, gray: np.ndarray, hidden: np.ndarray | None) -> None:
        """Move the points to their positions in the next frame; drop those that are lost."""
        xy = self._points["xy"]
        if not len(xy):
            return
        there, errors = track_round_trip(
            before, gray, xy, WINDOW_PX, levels=LEVELS, back_to_start=True
        )
        low, high = BORDER_PX, np.array(gray.shape[::-1]) - 1 - BORDER_PX
        kept = (
            (errors <= self.options.max_return_error_px)
            & (there >= low).all(axis=1)
            & (there <= high).all(axis=1)
            & ~at_pixels(hidden, there)
        )
        self._points["xy"] = there
        self._points = {name: values[kept] for name, values in self._points.items()}
        self._patches = self._patches.select(kept)

    def _drop_ignored(self, size: tuple[int, ...]) -> None:
        """Drop the points that the mask ignores in frames of `size`, (H, W)."""
        if self.ignore is not None:
            scale = np.divide(self.ignore.shape, size)[::-1]
            column, row = ((self._points["xy"] + 0.5) * scale).astype(np.int64).T
            kept = ~self.ignore[row, column]
            self._points = {name: values[kept] for name, values in self._points.items()}
            self._patches = self._patches.select(kept)

    def _return_to_patches(self, image: np.ndarray) -> None:
        """Align the points with their first patches; cut new patches for those that do not fit."""
        xy = self._points["xy"]
        places, affinities, found = find_patches(image, self._patches, xy)
        xy[found] = places[found]
        self._patches = self._patches._replace(affinities=affinities)
        if not found.all():
            new = cut_patches(image, xy[~found])
            for values, others in zip(self._patches, new, strict=True):
                values[~found] = others

    def _add(self, keypoints: Keypoints, image: np.ndarray) -> None:
        """Begin tracks with the best keypoints that are far enough from all tracks."""
        xy, most = self._points["xy"], self.options.max_keypoints
        distance = max(MIN_DISTANCE_PX, MIN_SPACING * math.sqrt(image.size / most))
        rows = free_keypoints(keypoints, xy, distance, most - len(xy))
        new = {
            "tracks": np.arange(len(rows)) + self._next_track,
            "xy": keypoints.xy[rows],
            "scores": keypoints.scores[rows],
            "ages": np.zeros(len(rows), np.int64),
        }
        self._next_track += len(rows)
        for name, values in self._points.items():
            self._points[name] = np.concatenate([values, new[name]])
        if len(rows):
            patches = zip(self._patches, cut_patches(image, new["xy"]), strict=True)
            self._patches = Patches(*map(np.concatenate, patches))


def free_keypoints(
    keypoints: Keypoints, taken: np.ndarray, distance_px: float, count: int
) -> np.ndarray:
    """Choose up to `count` keypoints, best first, over `distance_px` from tracks and each other.

    `taken` are the (M, 2) positions of the tracks. Returns the (K,) indices of the keypoints.
    Distances are measured between positions that are rounded to whole pixels.
    """
    width, height = keypoints.image_size
    radius = int(distance_px)
    blocked = np.zeros((height, width), np.uint8)
    for x, y in np.rint(taken).astype(int).tolist():
        cv2.circle(blocked, (x, y), radius, 1, -1)
    chosen: list[int] = []
    pixels = np.rint(keypoints.xy).astype(int).clip(0, (width - 1, height - 1)).tolist()
    for row in np.argsort(-keypoints.scores, kind="stable").tolist():
        if len(chosen) >= count:
            break
        x, y = pixels[row]
        if not blocked[y, x]:
            chosen.append(row)
            cv2.circle(blocked, (x, y), radius, 1, -1)
    return np.array(chosen, np.int64)


class Patches(NamedTuple):
    """N patches: (N, S, S) float32 pixels around their centres.

    The (N, 2, 2) float64 `affinities` map offsets of pixels from the centre of a patch to offsets
    in the image in which the patch was last found.
    """

    pixels: np.ndarray
    affinities: np.ndarray

    def select(self, rows: np.ndarray) -> Patches:
        """Return some of the patches; `rows` is a boolean mask or indices."""
        return Patches(*(each[rows] for each in self))


def cut_patches(image: np.ndarray, xy: np.ndarray) -> Patches:
    """Return patches around (N, 2) points of a blurred image.

    The pixels of patches too near to the image border are 0, so these patches are never found.
    """
    steps = np.arange(-KEPT_PX, KEPT_PX + 1, dtype=np.float32)
    offsets = np.stack(np.meshgrid(steps, steps)).reshape(2, -1)
    places = xy.astype(np.float32)[:, :, None] + offsets
    # Lanczos interpolation is used, because OpenCV's cubic kernel shifts by up to 0.05 px.
    pixels = np.concatenate(
        [
            cv2.remap(image, *part.transpose(1, 0, 2), cv2.INTER_LANCZOS4)
            for part in np.array_split(places, len(places) // MOST_READ + 1)
        ]
    )
    most = np.array(image.shape[::-1]) - 1 - KEPT_PX
    inside = np.all((xy >= KEPT_PX) & (xy <= most), axis=1)
    pixels = (pixels * inside[:, None]).reshape(-1, len(steps), len(steps))
    return Patches(pixels, np.tile(np.eye(2), (len(xy), 1, 1)))


def find_patches(
    image: np.ndarray, patches: Patches, xy: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find patches in a blurred image near (N, 2) expected positions.

    Returns the (N, 2) positions and (N, 2, 2) affinities of the patches, float64, and (N,) bool:
    whether each patch was found. If it was not, its position and affinity are meaningless.
    """
    count, side, _ = patches.pixels.shape
    centres = np.column_stack([np.full(count, KEPT_PX), np.arange(count) * side + KEPT_PX])
    column = patches.pixels.reshape(-1, side)  # all patches, one above the other
    aligned = align_patches((column, image), centres, xy, patches.affinities, ALIGNMENT)
    growth = np.linalg.det(aligned.affinities)
    regular = (growth > 1 / MAX_GROWTH) & (growth < MAX_GROWTH)
    return aligned.points1, aligned.affinities, aligned.converged & regular
