"""Options of panoramas: what counts as an overlap, the joint fit, and how images are blended."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..._shared.options import check_ranges, suggest_keywords
from ...features.sift_detector import SiftOptions


@suggest_keywords
@dataclass(frozen=True)
class StitchingOptions:
    """How photographs become a panorama.

    Attributes:
        sift: sparse keypoints by which overlaps are found.
        max_keypoints: dense keypoints per image that must confirm a homography.
        min_partners: pairs that each image takes part in, where it has that many, beyond those
            that connect all.
        max_correspondences: evenly spread matches per pair that the joint fit uses.
        huber_threshold_px: larger residuals have less weight in the joint fit.
        max_depth_ratio: how many times farther from the camera one corner of an image may lie on
            the canvas than another: beyond, it is seen too much from the side.
        seam_megapixels: size of the canvas, at the most, on which exposure and seams are found.
        min_overlap_px: pixels there by which two images must overlap for their brightness to be
            compared.
        gain_error_std, gain_prior_std: standard deviations of the logarithm of brightness: of what
            an overlap says about two images, and of the images themselves.
        num_bands: frequency bands; the coarsest blends over about 2^num_bands pixels.
        min_warp_scale: an image that the canvas shows smaller than this is downscaled first,
            against aliasing.

    Raises:
        OptionError: a value is out of its range.
    """

    sift: SiftOptions = field(default_factory=lambda: SiftOptions(max_keypoints=2000))
    max_keypoints: int = 30_000
    min_partners: int = 3
    max_correspondences: int = 400
    huber_threshold_px: float = 2.0
    max_depth_ratio: float = 5.0
    seam_megapixels: float = 0.5
    min_overlap_px: int = 100
    gain_error_std: float = 0.05
    gain_prior_std: float = 0.5
    num_bands: int = 5
    min_warp_scale: float = 0.67

    def __post_init__(self) -> None:
        check_ranges(
            self,
            positive=(
                *("max_keypoints", "huber_threshold_px", "seam_megapixels", "gain_error_std"),
                *("gain_prior_std", "min_overlap_px"),
            ),
            fractions=("min_warp_scale",),
            between={
                "min_partners": (1, 1000),
                "max_correspondences": (4, 1_000_000),
                "max_depth_ratio": (1, 1000),
                "num_bands": (1, 12),
            },
        )


DEFAULTS = StitchingOptions()
