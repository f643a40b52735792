"""Print density and correct matches of the classical detectors beside the paper's numbers.

    python benchmarks/paper_settings.py OXFORD [--only sift-low,orb-low] [--without-matches]

Tables I and II of docs/benchmark-report.md: the mean density over all images, over those of all
scenes but one, and the correct matches of the paper's pairs, of binary descriptors both by
Hamming's distance and by kd-trees over their bytes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from deepdetect.datasets.oxford import load_oxford
from deepdetect.datasets.types import PlanarScene
from deepdetect.evaluation.baselines.method import LocalFeature
from deepdetect.evaluation.baselines.opencv import CLASSICAL, with_kd_trees
from deepdetect.evaluation.context import BenchmarkContext
from deepdetect.evaluation.planar_benchmarks import select_pairs
from deepdetect.evaluation.protocols.paper import OXFORD_PAIRS, mean_correct_matches
from deepdetect.evaluation.protocols.paper_numbers import DENSITY, FIGURE_6, MATCHES


def densities(context: BenchmarkContext, feature: LocalFeature, scenes: list[PlanarScene]) -> str:
    """Measure the density, and find the scene without which it is nearest to the paper's."""
    found = {
        scene.name: [context.keypoints(feature, image).features.density for image in scene.images]
        for scene in scenes
    }

    def mean(left_out: str = "") -> float:
        return float(np.mean([values for name, values in found.items() if name != left_out]))

    paper = DENSITY[feature.title]
    nearest = min(found, key=lambda name: abs(mean(name) - paper))
    return f"{paper:.4f} | {mean():.4f} | {mean(nearest):.4f} without {nearest}"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("oxford", type=Path)
    parser.add_argument("--only", default=",".join(CLASSICAL), help="names with commas between")
    parser.add_argument("--without-matches", action="store_true")
    arguments = parser.parse_args()
    context = BenchmarkContext(arguments.oxford)
    scenes = load_oxford(arguments.oxford)
    chosen = [CLASSICAL[name] for name in arguments.only.split(",")]
    print("| method | density in the paper | ours | ours without a scene |\n|---|---|---|---|")
    for feature in chosen:
        print(f"| {feature.title} | {densities(context, feature, scenes)} |", flush=True)
    if arguments.without_matches:
        return
    pairs = select_pairs(scenes, (*OXFORD_PAIRS, ("graf", 3)))
    print("\n| method | pair | correct in the paper | ours |\n|---|---|---|---|")
    for feature in with_kd_trees(chosen):
        paper = {**FIGURE_6.get(feature.title, {}), **MATCHES.get(feature.title, {})}
        for pair in pairs:
            if pair.name in paper:
                correct, _ = mean_correct_matches(context, feature, pair)
                row = f"| {feature.title} | {pair.name} | {paper[pair.name]:,} | {correct:,} |"
                print(row, flush=True)


if __name__ == "__main__":
    main()
