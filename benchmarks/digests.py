"""Digests of what the library returns: equal before and after a change that must change nothing.

    python benchmarks/digests.py digests.json
    python benchmarks/digests.py digests.json --compare before.json

Heat maps, keypoints, matches by descriptors alone and guided, and point clouds, of some pairs of
the Oxford set, Middlebury, a pair of the fountain and scikit-image's Motorcycle pair. The two files
must come from the same machine: another processor rounds differently.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from deepdetect import (
    DeepDetect,
    MatchingOptions,
    PointDetector,
    SelectionOptions,
    load_image,
    match_images,
    reconstruct,
)
from deepdetect.matching import PUBLISHED_MATCHING

SHARED = Path(__file__).parents[2] / "shared" / "data"
OXFORD = ("graf 1 3", "wall 1 4", "bikes 1 4", "boat 1 6", "ubc 1 6", "leuven 1 4")
MIDDLEBURY = ("cones", "art", "moebius")


def main() -> None:
    """Write the digests, and name those that differ from an earlier file."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("--compare", type=Path)
    arguments = parser.parse_args()
    digests: dict[str, Any] = {}
    for name, values in results():
        digests[name] = digest(values)
        print(name, digests[name], flush=True)
    arguments.output.write_text(json.dumps(digests, indent=1) + "\n")
    if arguments.compare:
        before = json.loads(arguments.compare.read_text())
        differ = [name for name in before if before[name] != digests.get(name)]
        print(f"{len(before) - len(differ)} of {len(before)} equal", *differ, sep="\n")
        raise SystemExit(bool(differ))


def results() -> Any:
    """Yield names and arrays."""
    detector = DeepDetect(backend="onnxruntime")
    for pair in OXFORD:
        scene, first, second = pair.split()
        images = [load_image(SHARED / "oxford" / scene / f"img{k}.png") for k in (first, second)]
        yield f"{pair} heat map", [detector.heatmap(image) for image in images]
        yield f"{pair} keypoints", keypoint_arrays(detector.detect(images[0]))
        yield f"{pair} best", keypoint_arrays(PointDetector(2048).detect(images[0]))
        yield f"{pair} guided", match_arrays(match_images(*images, detector))
    images = [load_image(SHARED / "oxford" / "leuven" / f"img{k}.png") for k in (1, 2)]
    published = DeepDetect(backend="onnxruntime", resolution=480, network_channels="bgr")
    unguided: dict[str, Any] = {"guided_matching": False}
    found = match_images(*images, published, model="none", options=PUBLISHED_MATCHING, **unguided)
    yield "leuven published", match_arrays(found)
    unguided["selection"] = SelectionOptions(density=0.05)
    options = MatchingOptions(matcher="exact")
    found = match_images(*images, detector, mutual=True, options=options, **unguided)
    yield "leuven unguided", match_arrays(found)
    unguided["selection"] = SelectionOptions(density=0.2)
    options = MatchingOptions(matcher="patchmatch")
    found = match_images(*images, detector, options=options, **unguided)
    yield "leuven patchmatch", match_arrays(found)
    for scene in MIDDLEBURY:
        folder = SHARED / "middlebury" / scene
        pair = folder / "left.png", folder / "right.png"
        made = reconstruct(*pair, calibration=folder / "calib.json")
        yield f"{scene} cloud", cloud_arrays(made)
        every = SelectionOptions(density=1)
        made = reconstruct(
            *pair, calibration=folder / "calib.json", rectified=True, selection=every
        )
        yield f"{scene} every pixel", cloud_arrays(made)
    fountain = SHARED / "fountain"
    made = reconstruct(fountain / "0004.jpg", fountain / "0005.jpg", focal_px=2759.48 / 2)
    yield "fountain cloud", cloud_arrays(made)
    from skimage.data import stereo_motorcycle

    left, right, _ = stereo_motorcycle()
    yield "motorcycle guided", match_arrays(match_images(left, right, detector))
    made = reconstruct(left, right, focal_px=994.978)
    yield "motorcycle cloud", cloud_arrays(made)


def keypoint_arrays(keypoints: Any) -> list[np.ndarray]:
    """Return what a set of keypoints consists of."""
    return [keypoints.xy, keypoints.scores, keypoints.logits]


def match_arrays(matches: Any) -> list[np.ndarray]:
    """Return what the matches of a pair consist of, but for their scores."""
    parts = [matches.points0, matches.points1, matches.inliers]
    return parts if matches.matrix is None else [*parts, matches.matrix]


def cloud_arrays(made: Any) -> list[np.ndarray]:
    """Return what a reconstruction consists of."""
    parts = [made.points, made.colors, made.pixels]
    return parts if made.disparity is None else [*parts, made.disparity]


def digest(values: list[np.ndarray]) -> list[Any]:
    """Return a digest of all arrays, and a length that a person can read."""
    sha = hashlib.sha256()
    for value in values:
        sha.update(str((value.dtype, value.shape)).encode())
        sha.update(np.ascontiguousarray(value).tobytes())
    return [sha.hexdigest()[:16], len(values[0])]


if __name__ == "__main__":
    main()
