"""Match images from different sensors and seasons, and maps; count correct and wrong answers.

    python benchmarks/modalities.py FOLDER [--method xfeat_2048_600x800.onnx ...]

FOLDER is Multimodal_Image_Matching_Datasets of the repository StaRainJ/Multi-modality-image-
matching-database-metrics-methods on GitHub. Each of its `*/*/*.mat` has two images, their
homography and landmarks marked by hand. A match is correct within 5 px, or within three times the
median error of the homography at the landmarks if that is more. "Answered" counts pairs for which
`match_images` finds matches, "wrong" the answered pairs with fewer than half of the matches
correct. The columns of other methods count the correct matches of all pairs, from 2,048 keypoints
per image, matched as mutual nearest neighbours without a ratio test.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from descriptors import KEYPOINTS, methods
from scipy.io import loadmat

from deepdetect import (
    DeepDetect,
    ImageError,
    Matches,
    PointDetector,
    match_features,
    match_images,
)
from deepdetect.geometry.transforms import transfer_errors, transform_points, translation_matrix
from deepdetect_lab.evaluation.report import Row, Table

RIGHT_PX, LANDMARK_ERRORS = 5.0, 3.0
"""Error limits of a correct match, of which the larger one holds: in pixels, and as a multiple of
the landmarks' median error. Chosen by hand."""


class ModalPair:
    """Two (H, W, 3) uint8 images, their homography, and the error limit of correct matches."""

    def __init__(self, path: Path) -> None:
        found = loadmat(path)
        self.images = to_bytes(found["I_fix"]), to_bytes(found["I_move"])
        landmarks = [found["Landmarks"][name][0, 0] - 1.0 for name in ("LMfix", "LMmov")]
        # MATLAB's matrix maps row vectors of the second image to the first; pixels count from 1.
        matrix = np.linalg.inv(found["T"].astype(np.float64).T)
        self.homography = translation_matrix(-1, -1) @ matrix @ translation_matrix(1, 1)
        off = np.median(
            np.linalg.norm(transform_points(landmarks[0], self.homography) - landmarks[1], axis=1)
        )
        self.right_px = max(RIGHT_PX, LANDMARK_ERRORS * float(off))

    def right(self, matches: Matches) -> int:
        """Count correct matches."""
        if not len(matches):
            return 0
        errors = transfer_errors(matches.points0, matches.points1, self.homography)
        return int(np.count_nonzero(errors < self.right_px))


def to_bytes(image: np.ndarray) -> np.ndarray:
    """Convert an image to uint8; some are floats in [0, 1]."""
    if image.dtype != np.uint8:
        image = np.rint(image * (255 if image.max() <= 1 else 1)).clip(0, 255)
    return np.ascontiguousarray(image.astype(np.uint8))


def measure(paths: Sequence[Path], files: Sequence[str]) -> Row:
    """Return the columns of the table for pairs of one kind."""
    known, others = methods([*files]), [Path(file).stem for file in files]
    edges = PointDetector(KEYPOINTS, descriptor="cross-modal").extract
    extractors = {"learned": known["learned"], "cross-modal": edges}
    extractors |= {name: known[name] for name in others}
    detector, answers, right = DeepDetect(), [], dict.fromkeys(extractors, 0)
    for pair in map(ModalPair, paths):
        try:
            matches = match_images(*pair.images, detector)
            good = 2 * pair.right(matches) >= len(matches)
            answers.append((len(matches) > 0, matches.geometry.confidence == "high", good))
        except ImageError:  # a round picture of a retina counts as a fisheye picture
            answers.append((False, False, False))
        for name, extract in extractors.items():
            first, second = (extract(image) for image in pair.images)
            right[name] += pair.right(match_features(first, second, ratio=1))
    answered, high, good = np.array(answers).T
    return {
        "pairs": len(paths),
        "answered": int(np.count_nonzero(answered)),
        "wrong": int(np.count_nonzero(answered & ~good)),
        "wrong, high confidence": int(np.count_nonzero(high & ~good)),
        **right,
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--method", action="append", default=[], help="an ONNX file")
    given = parser.parse_args()
    kinds = sorted({path.parent for path in given.folder.glob("*/*/*.mat")})
    rows: list[Row] = [
        {
            "images": f"{kind.parent.name}, {kind.name.replace('_', ' ')}",
            **measure(sorted(kind.glob("*.mat")), given.method),
        }
        for kind in kinds
    ]
    rows.append({"images": "all", **{n: sum(row[n] for row in rows) for n in [*rows[0]][1:]}})
    styles = dict.fromkeys(rows[0], ",d") | {"images": ""}
    print(Table("modalities", "modalities", styles, rows).to_markdown())


if __name__ == "__main__":
    main()
