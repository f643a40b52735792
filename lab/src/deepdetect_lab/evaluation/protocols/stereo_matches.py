"""Match stereo pairs by descriptors alone, and evaluate the matches by the true disparity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from deepdetect._shared.progress import progress
from deepdetect.detector.detector import AnyDetector
from deepdetect.features.matches import Matches
from deepdetect.features.selection import SelectionOptions

from ...datasets.middlebury import StereoPair
from ..baselines.random import AllPixels, RandomDetector
from ..metrics.stereo import stereo_score
from ..unguided import UPRIGHT_SIFT, match_unguided


def score_stereo_matches(
    sources: Mapping[str, AnyDetector], pairs: Sequence[StereoPair], *, quiet: bool = True
) -> list[dict[str, Any]]:
    """Match rectified pairs with the keypoints of several detectors, and evaluate the matches.

    `sources` maps names to detectors. Descriptors are matched over the whole image, without using
    the rectification. Returns a row for each detector and pair. After the rows of a detector come
    those of random points with its density, because more keypoints always give more matches. The
    rows with all pixels as keypoints come last.
    """
    rows: list[dict[str, Any]] = []
    with progress(len(pairs) * (2 * len(sources) + 1), "matching", "pair", quiet) as bar:

        def evaluate(source: str, pair: StereoPair, found: Matches) -> None:
            density = (found.keypoints0.density + found.keypoints1.density) / 2
            score = stereo_score(found.points0, found.points1, pair.disparity)
            rows.append({"source": source, "pair": pair.name, "density": density, **score})
            bar.update(1)

        for name, detector in sources.items():
            for pair in pairs:
                evaluate(name, pair, match_stereo(pair, detector))
            for pair, row in zip(pairs, rows[-len(pairs) :], strict=True):
                evaluate(f"random, as {name}", pair, match_random_points(pair, row["density"]))
        for pair in pairs:
            evaluate("all pixels", pair, match_stereo(pair, AllPixels()))
    return rows


def match_stereo(pair: StereoPair, detector: AnyDetector, density: float | None = None) -> Matches:
    """Match the two views by descriptors alone, without estimating a geometry."""
    selection = SelectionOptions(density=density)
    return match_unguided(
        pair.left, pair.right, detector, selection=selection, descriptor=UPRIGHT_SIFT
    )


def match_random_points(pair: StereoPair, density: float) -> Matches:
    """Match random points as a chance baseline. `density` is the number of points per pixel."""
    return match_stereo(pair, RandomDetector(), max(density, 1e-6))
