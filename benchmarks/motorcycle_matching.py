"""Unguided matching of the Motorcycle pair by several options: how many matches, how many right.

    python benchmarks/motorcycle_matching.py [--weights FILE]

The pair lies inside scikit-image. Right: within 1 px of the true disparity, of those where it is
known; of all matches, and of those that fit the geometry.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from deepdetect import DeepDetect, MatchingOptions, match_images
from deepdetect.datasets.middlebury import load_motorcycle
from deepdetect.evaluation.metrics.stereo import stereo_score


def _unguided(mutual: bool = False, **options: Any) -> dict[str, Any]:
    return {
        "guided_matching": False,
        "mutual": mutual,
        "options": MatchingOptions(**options),
    }


WAYS: dict[str, dict[str, Any]] = {
    "guided": {},
    "unguided": _unguided(),
    "... mutual": _unguided(mutual=True),
    "... ratio=0.9": _unguided(ratio=0.9),
    "... ratio=0.9, mutual": _unguided(mutual=True, ratio=0.9),
    "... ratio=0.9, mutual, patchmatch": _unguided(mutual=True, ratio=0.9, matcher="patchmatch"),
}


def main() -> None:
    """Print a row of a table for each way."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--weights", default="default")
    detector = DeepDetect(parser.parse_args().weights)
    pair = load_motorcycle()
    print("| options | matches, within 1 px | inliers, within 1 px |\n|---|---|---|")
    for name, options in WAYS.items():
        found = match_images(pair.left, pair.right, detector, **options)
        cells = []
        for kept in (np.ones(len(found), bool), found.inliers):
            score = stereo_score(found.points0[kept], found.points1[kept], pair.disparity)
            cells.append(f"{score['matches']:,}, {score['precision']:.1%}")
        print(f"| `{name}` | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
