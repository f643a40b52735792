"""Guided matching on Oxford: of what could be matched, how much is, and how much of it is right.

    python benchmarks/guided_matching.py OXFORD [--weights FILE] [--paste]

OXFORD is the data set with refined homographies (`H1toKp.refined`). The truth only judges. With
--paste a photograph that has nothing to do with the pair covers a quarter of the second image, and
the share of the points under it that are matched nevertheless is printed.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np

from deepdetect import DeepDetect, HeatmapOptions, match_images
from deepdetect.datasets.oxford import find_scene, load_oxford
from deepdetect.geometry import transform_points
from deepdetect.guidance.by_homography import nearest_pixel
from deepdetect.image import load_image
from deepdetect.metrics.homography_accuracy import corner_error

PAIRS = (
    *(("graf", 6), ("wall", 6), ("bikes", 6), ("leuven", 6), ("trees", 6), ("ubc", 6)),
    *(("boat", 2), ("boat", 6), ("bark", 6)),
)


def main() -> None:
    """Print a line for each pair."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("oxford", type=Path)
    parser.add_argument("--weights", default="matching")
    parser.add_argument("--paste", action="store_true", help="cover a quarter with a photograph")
    arguments = parser.parse_args()
    scenes = {truth: load_oxford(arguments.oxford, truth) for truth in ("refined", "published")}
    detector = DeepDetect(arguments.weights).configured(HeatmapOptions(480))
    for scene, number in PAIRS:
        pairs = {
            truth: list(find_scene(scenes[truth], scene).pairs())[number - 2] for truth in scenes
        }
        pair = pairs["refined"]
        rgb = [load_image(image) for image in (pair.first, pair.second)]
        if arguments.paste:
            print(pair.name, _pasted(rgb, pair.homography, detector))
            continue
        started = time.perf_counter()
        found = match_images(*rgb, detector, guidance="auto")
        seconds = time.perf_counter() - started
        points = [keypoints.xy for keypoints in (found.keypoints0, found.keypoints1)]
        places = transform_points(points[0], pair.homography)
        size1 = (rgb[1].shape[1], rgb[1].shape[0])
        ceiling = np.count_nonzero(nearest_pixel(places, points[1], size1)[1] < 1)
        correct = {
            truth: np.linalg.norm(
                transform_points(found.points0, pairs[truth].homography) - found.points1, axis=1
            )
            < 1
            for truth in pairs
        }
        right = correct["refined"]
        once = len(np.unique(found.points1[right], axis=0))
        size0 = (rgb[0].shape[1], rgb[0].shape[0])
        model = found.model if found.kind == "homography" else None
        print(
            f"{pair.name}: {found.kind}, guided {found.guided}; correct {right.sum():,}, of the "
            f"ceiling {right.sum() / ceiling:.3f}, precision {right.mean():.3f}, one to one "
            f"{once:,}; by the published homography {correct['published'].sum():,}; corners off "
            f"{corner_error(model, pair.homography, size0):.2f} px; {seconds:.1f} s",
            flush=True,
        )


def _pasted(rgb: list[np.ndarray], homography: np.ndarray, detector: DeepDetect) -> str:
    from skimage import data

    shares = []
    height, width = rgb[1].shape[0] // 2, rgb[1].shape[1] // 2
    for name in ("chelsea", "coffee", "rocket", "astronaut", "grass"):
        photograph = load_image(getattr(data, name)())
        strange = cv2.resize(photograph, (width, height), interpolation=cv2.INTER_AREA)
        top, left = height // 2, width // 2
        second = rgb[1].copy()
        second[top : top + height, left : left + width] = strange
        found = match_images(rgb[0], second, detector, guidance="auto")

        def under(points: np.ndarray) -> np.ndarray:
            x, y = (transform_points(points, homography) + 0.5).T
            return (x > left) & (x < left + width) & (y > top) & (y < top + height)  # noqa: B023

        covered = under(found.keypoints0.xy).sum()
        shares.append(f"{name} {under(found.points0).sum() / max(covered, 1):.3%}")
    return "matched under " + ", ".join(shares)


if __name__ == "__main__":
    main()
