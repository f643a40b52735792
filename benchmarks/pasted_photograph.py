"""What guided matching matches where nothing can be matched: under a photograph that is pasted in.

    python benchmarks/pasted_photograph.py [OXFORD] [--middlebury DATA] [--weights FILE] [--seeds N]

OXFORD holds refined homographies (`H1toKp.refined`), DATA the stereo scenes cones, teddy and art. A
photograph that has nothing to do with the pair covers a quarter of the second image, its middle; of
the keypoints that belong under it the fraction is printed that is matched nevertheless, the median
and the largest over the seeds. The ground truth says which keypoints these are, and how many
matches of the stereo pairs are correct (within 1 px) without the photograph.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from skimage import data

from deepdetect import DeepDetect, HeatmapOptions, Matches, match_images
from deepdetect.datasets.middlebury import load_middlebury
from deepdetect.datasets.oxford import load_oxford
from deepdetect.evaluation.metrics.stereo import stereo_score
from deepdetect.evaluation.planar_benchmarks import GUIDED_PAIRS, select_pairs
from deepdetect.geometry import transform_points
from deepdetect.io.image import load_image

PHOTOGRAPHS = ("chelsea", "coffee", "rocket", "astronaut", "grass")
SCENES = ("cones", "teddy", "art")


def main() -> None:
    """Print a line for each pair."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("oxford", type=Path, nargs="?")
    parser.add_argument("--middlebury", type=Path, help="folder of the stereo scenes")
    parser.add_argument("--weights", default="default")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--pair", action="append", help="as 'ubc 1-6'; default all nine")
    arguments = parser.parse_args()
    if arguments.oxford is None and arguments.middlebury is None:
        parser.error("name the folder OXFORD, or --middlebury DATA, or both")
    detector = DeepDetect(arguments.weights)
    if arguments.oxford is not None:
        squashed = detector.configured(HeatmapOptions(480))
        for pair in select_pairs(load_oxford(arguments.oxford, "refined"), GUIDED_PAIRS):
            if arguments.pair and pair.name not in arguments.pair:
                continue
            first, second = (load_image(image) for image in (pair.first, pair.second))

            def moved(points: np.ndarray, homography: np.ndarray = pair.homography) -> np.ndarray:
                return transform_points(points, homography)

            texts = under_photographs(first, second, moved, squashed, arguments.seeds)
            print(f"{pair.name}: matched under {texts}", flush=True)
    for name in SCENES if arguments.middlebury is not None else ():
        scene = load_middlebury(arguments.middlebury / name)
        whole = match_images(scene.left, scene.right, detector)
        score = stereo_score(whole.points0, whole.points1, scene.disparity)

        def by_depth(points: np.ndarray, disparity: np.ndarray = scene.disparity) -> np.ndarray:
            return moved_by_disparity(points, disparity)

        texts = under_photographs(scene.left, scene.right, by_depth, detector, arguments.seeds)
        print(
            f"{name}: {score.correct:,} right ({score.precision:.3f}), matched under {texts}",
            flush=True,
        )


def under_photographs(
    first: np.ndarray,
    second: np.ndarray,
    moved: Callable[[np.ndarray], np.ndarray],
    detector: DeepDetect,
    seeds: int,
) -> str:
    """Return the shares under each photograph as text; `moved` is the truth."""
    texts = []
    for name in PHOTOGRAPHS:
        pasted, box = paste(second, load_image(getattr(data, name)()))
        shares, guided = [], True
        for seed in range(seeds):
            found = match_images(first, pasted, detector, seed=seed)
            shares.append(share_under(found, moved, box))
            guided &= found.guided
        text = f"{np.median(shares):.2%}"
        if seeds > 1:
            text += f" (at most {max(shares):.2%})"
        texts.append(f"{name} {text}{'' if guided else ' unguided'}")
    return ", ".join(texts)


def moved_by_disparity(points: np.ndarray, disparity: np.ndarray) -> np.ndarray:
    """Return where whole pixels of the left view are in the right one, NaN where unknown."""
    x, y = np.asarray(points).astype(int).T
    return np.column_stack([x - disparity[y, x], y])


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


def share_under(
    found: Matches,
    moved: Callable[[np.ndarray], np.ndarray],
    box: tuple[int, int, int, int],
) -> float:
    """Return which fraction of the first image's keypoints under the box is matched."""
    left, top, width, height = box

    def under(points: np.ndarray) -> np.ndarray:
        x, y = (moved(points) + 0.5).T
        return (x > left) & (x < left + width) & (y > top) & (y < top + height)

    return float(under(found.points0).sum() / max(under(found.keypoints0.xy).sum(), 1))


if __name__ == "__main__":
    main()
