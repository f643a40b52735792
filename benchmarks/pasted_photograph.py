"""What guided matching matches where nothing can be matched: under a photograph that is pasted in.

    python benchmarks/pasted_photograph.py OXFORD [--weights FILE] [--seeds N]

OXFORD holds refined homographies (`H1toKp.refined`). A photograph that has nothing to
do with the pair covers a quarter of the second image, its middle; of the keypoints that
belong under it the share is printed that is matched nevertheless, the median and the largest over
the seeds. The truth only tells which keypoints these are.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from skimage import data

from deepdetect import DeepDetect, HeatmapOptions, Matches, match_images
from deepdetect.benchmark.oxford import GUIDED_PAIRS, chosen_pairs
from deepdetect.datasets.oxford import load_oxford
from deepdetect.geometry import transform_points
from deepdetect.image import load_image

PHOTOGRAPHS = ("chelsea", "coffee", "rocket", "astronaut", "grass")


def main() -> None:
    """Print a line for each pair."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("oxford", type=Path)
    parser.add_argument("--weights", default="matching")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--pair", action="append", help="as 'ubc 1-6'; default all nine")
    arguments = parser.parse_args()
    detector = DeepDetect(arguments.weights).configured(HeatmapOptions(480))
    for pair in chosen_pairs(load_oxford(arguments.oxford, "refined"), GUIDED_PAIRS):
        if arguments.pair and pair.name not in arguments.pair:
            continue
        first, second = (load_image(image) for image in (pair.first, pair.second))
        told = []
        for name in PHOTOGRAPHS:
            pasted, box = paste(second, load_image(getattr(data, name)()))
            shares, guided = [], True
            for seed in range(arguments.seeds):
                found = match_images(first, pasted, detector, seed=seed)
                shares.append(share_under(found, pair.homography, box))
                guided &= found.guided
            text = f"{np.median(shares):.2%}"
            if arguments.seeds > 1:
                text += f" (at most {max(shares):.2%})"
            told.append(f"{name} {text}{'' if guided else ' unguided'}")
        print(f"{pair.name}: matched under {', '.join(told)}", flush=True)


def paste(
    image: np.ndarray, photograph: np.ndarray
) -> tuple[np.ndarray, tuple[int, int, int, int]]:
    """Cover the middle quarter; return the image and (left, top, width, height)."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    left, top = width // 2, height // 2
    result = image.copy()
    result[top : top + height, left : left + width] = cv2.resize(
        photograph, (width, height), interpolation=cv2.INTER_AREA
    )
    return result, (left, top, width, height)


def share_under(found: Matches, homography: np.ndarray, box: tuple[int, int, int, int]) -> float:
    """Return which share of the first image's keypoints under the box is matched."""
    left, top, width, height = box

    def under(points: np.ndarray) -> np.ndarray:
        x, y = (transform_points(points, homography) + 0.5).T
        return (x > left) & (x < left + width) & (y > top) & (y < top + height)

    return float(under(found.points0).sum() / max(under(found.keypoints0.xy).sum(), 1))


if __name__ == "__main__":
    main()
