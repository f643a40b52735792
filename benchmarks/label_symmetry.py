"""Print how each detector's labels follow a mirrored or transposed photograph.

    python benchmarks/label_symmetry.py PHOTOS [--every 300]

The table of docs/training.md, "What may be done to a crop": intersection over union of the
changed photograph's label with the changed label of the photograph, over all photographs.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from deepdetect.io.image import find_images, load_image, luma
from deepdetect.labels import DETECTOR_NAMES, LabelOptions, fuse

CHANGES = {
    "left to right": lambda pixels: pixels[:, ::-1],
    "upside down": lambda pixels: pixels[::-1],
    "transposed": lambda pixels: pixels.swapaxes(0, 1),
}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("photographs", type=Path)
    parser.add_argument("--every", type=int, default=300, help="take every n-th (default 300)")
    arguments = parser.parse_args()
    common = {(name, change): np.zeros(2, int) for name in DETECTOR_NAMES for change in CHANGES}
    for path in find_images(arguments.photographs)[:: arguments.every]:
        image = luma(load_image(path))
        for name in DETECTOR_NAMES:
            options = LabelOptions((name,))
            mask = fuse(image, options).mask
            for change, apply in CHANGES.items():
                found = fuse(np.ascontiguousarray(apply(image)), options).mask
                expected = apply(mask)
                common[name, change] += (found & expected).sum(), (found | expected).sum()
    print("| detector | " + " | ".join(CHANGES) + " |\n|---|" + "---|" * len(CHANGES))
    for name in DETECTOR_NAMES:
        both = [common[name, change] for change in CHANGES]
        print(f"| {name} | " + " | ".join(f"{same / union:.3f}" for same, union in both) + " |")


if __name__ == "__main__":
    main()
