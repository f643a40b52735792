"""The numbers of the paper that stand beside ours.

"DeepDetect: Learning All-in-One Dense Keypoints", Tareen, Tareen, Fan and Yuan, arXiv:2510.17422,
version 3. Only what is known for certain is here; the rest of its tables is shown as a dash.
"""

from __future__ import annotations

MATCHES: dict[str, int] = {
    "graf 1-6": 102,
    "wall 1-6": 4_756,
    "bikes 1-6": 16_581,
    "leuven 1-6": 59_003,
    "trees 1-6": 9_368,
    "ubc 1-6": 40_204,
}
"""Table II: correct matches of DeepDetect at a threshold of 0.5."""

NOTEBOOK_MATCHES: dict[str, dict[str, tuple[int, int]]] = {
    "DeepDetect": {"wall 1-6": (4_770, 479_562)},
    "SIFT, low settings": {"wall 1-6": (52, 163_510)},
}
"""Correct matches, and all, that the authors' public notebooks print: Table II's protocol."""

NOTEBOOK_KEYPOINTS: dict[str, tuple[int, int]] = {
    "DeepDetect": (605_433, 477_060),
    "SIFT, low settings": (184_084, 118_628),
}
"""The keypoints of both images of wall 1-6 that they print."""

DENSITY = 0.5143
"""Table I: mean density of DeepDetect at a threshold of 0.5, on Oxford."""

REPEATABILITY = 0.9582
"""Figure 1: mean repeatability of DeepDetect. It is above what clipping at 1 leaves."""

SIX_SCENES = 0.942
"""Table III: mean repeatability on graf, wall, bikes, leuven, trees and ubc, which clipping each
pair at 1 gives within 0.01 for each of them."""

MOST_MATCHES = 338_118
"""Abstract: the most correct matches of one pair, on HPatches."""

STEREO_POINTS: dict[str, int] = {
    "cones": 49_979,
    "dolls": 540_780,
    "moebius": 363_703,
    "rocks": 709_425,
    "cloth": 842_045,
}
"""Figure 8: matches that are left after the essential matrix ("voxels")."""

SIFT_LOW_POINTS: dict[str, int] = {"cones": 14_128}
"""The same of SIFT with low settings, as the authors' notebook prints it."""
