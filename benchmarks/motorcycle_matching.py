"""Match the Motorcycle pair with several options, and print the precision of the matches.

    python benchmarks/motorcycle_matching.py [--weights FILE]

The pair comes with scikit-image. Precision is the share of matches within 1 px of the ground-truth
disparity, where that is known. It is printed for all matches and for inliers of the geometry. For
comparison, the last row has as many random points as keypoints.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from deepdetect import DeepDetect, estimate_geometry, match_images
from deepdetect_lab.datasets.middlebury import load_motorcycle
from deepdetect_lab.evaluation.metrics.stereo import stereo_score
from deepdetect_lab.evaluation.protocols.stereo_matches import match_random_points
from deepdetect_lab.evaluation.unguided import UPRIGHT_SIFT, match_unguided

UNGUIDED: dict[str, dict[str, Any]] = {
    "unguided": {},
    "... mutual": {"mutual": True},
    "... ratio=0.9": {"ratio": 0.9},
    "... ratio=0.9, mutual": {"mutual": True, "ratio": 0.9},
    "... ratio=0.9, mutual, patchmatch": {"mutual": True, "ratio": 0.9, "matcher": "patchmatch"},
}


def main() -> None:
    """Print a table with a row for each set of options."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--weights", default="default")
    detector = DeepDetect(parser.parse_args().weights)
    pair = load_motorcycle()
    print("| options | matches | within 1 px | inliers | of these within 1 px |")
    print("|---|---|---|---|---|")
    found = {"guided": match_images(pair.left, pair.right, detector)}
    for name, options in UNGUIDED.items():
        matches = match_unguided(
            pair.left, pair.right, detector, descriptor=UPRIGHT_SIFT, **options
        )
        found[name] = matches.with_geometry(estimate_geometry(matches, model="auto"))
    both = found["guided"].keypoints0, found["guided"].keypoints1
    density = sum(each.density for each in both) / 2
    found["random points, unguided"] = match_random_points(pair, density)
    for name, matches in found.items():
        cells = []
        for kept in (np.ones(len(matches), bool), matches.inliers):
            score = stereo_score(matches.points0[kept], matches.points1[kept], pair.disparity)
            cells += [f"{score['matches']:,}", f"{score['precision']:.1%}"]
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
