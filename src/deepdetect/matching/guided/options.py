"""Every tuned number of guided matching, with its unit.

The bounds of the verification and the sizes of its windows were chosen on nine pairs of Oxford,
with parts of their second images covered; what tells a plane from depth, and the values of matching
by rectification, on all of Oxford and Middlebury, Strecha's fountain and a KITTI clip.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ..._shared.options import check_ranges, suggest_keywords
from ...features.sift_detector import SiftOptions
from ...geometry.acontrario import MAX_LOG10_NFA
from ...geometry.epipolar_rectification import RectificationFrameOptions
from ...geometry.model_selection import ModelSelectionOptions
from ...geometry.semi_calibrated import SemiCalibratedOptions
from ...geometry.validated_refinement import ValidatedRefinementOptions
from ..stereo.matching import DisparityOptions
from .along_lines import LineSearchOptions


@suggest_keywords
@dataclass(frozen=True)
class InitialGeometryOptions:
    """How a geometry is estimated from sparse matches.

    Attributes:
        first_side_px: longer sides are scaled down to this for a first look, which decides where
            the pair is clearly a plane.
        first_max_keypoints: of each image in the first look.
        min_first_inliers, min_first_fraction: number and fraction of the matches of the first look
            that agree with a homography, for it to decide. The number holds for points as well.
        max_first_parallax: with more matches than this that agree on an epipole off the plane,
            relative to those on it, the first look does not decide.
        max_side_px: longer sides are scaled down to this: the initial geometry need not be fine.
        sift: the keypoints of each image.
        min_points: where both images have at least so many points of all scales (a budget was
            asked for), these take the place of SIFT's keypoints; where too few of their matches
            agree, SIFT is tried.
        simulated_side_px, simulated_max_keypoints: side and keypoints of images of which views are
            simulated; each view gets half as many keypoints.
        max_ratios: of the ratio test, in the order in which they are tried: fewer matches, with
            fewer wrong ones among them, may show what more do not.
        min_separation_px: matches that begin or end nearer together than this count as one.
        homography_threshold_px, fundamental_threshold_px: matches within this agree with a model,
            in pixels of the scaled images.
        max_log10_nfa: a geometry is trusted when the logarithm of its number of false alarms is
            below this.
        semi_calibrated: what a fundamental matrix may assume of both cameras, where no plane
            guides; None: nothing, as for small copies, where it would take as long as the rest.
        line_search: when keypoints match, once a fundamental matrix is known.
        max_matches_to_search: with fewer that agree with it, it looks for more.
        model_selection: when the matches alone show that a scene has depth.
        tilts: of the simulated views: how many times shorter one direction is seen.
        max_hint_log10_nfa: where the logarithm of the number of false alarms of the best geometry
            so far is below this, it may be more than chance: views of a larger tilt are simulated,
            and further matches along epipolar lines are counted.
        rotation_step_deg: between the directions of the views for a tilt of 1; the step is
            inversely proportional to the tilt.

    Raises:
        OptionError: a value is out of its range.
    """

    first_side_px: int = 640
    first_max_keypoints: int = 2000
    min_first_inliers: int = 50
    min_first_fraction: float = 0.5
    min_first_depth_inliers: int = 200
    max_first_parallax: float = 0.1
    max_side_px: int = 1200
    simulated_side_px: int = 320
    simulated_max_keypoints: int = 1000
    sift: SiftOptions = field(default_factory=SiftOptions)
    min_points: int = 1000
    max_ratios: tuple[float, ...] = (0.85, 0.8)
    min_separation_px: float = 2.0
    homography_threshold_px: float = 3.0
    fundamental_threshold_px: float = 1.5
    max_log10_nfa: float = MAX_LOG10_NFA
    semi_calibrated: SemiCalibratedOptions | None = field(default_factory=SemiCalibratedOptions)
    line_search: LineSearchOptions = field(default_factory=LineSearchOptions)
    max_matches_to_search: int = 200
    model_selection: ModelSelectionOptions = field(default_factory=ModelSelectionOptions)
    tilts: tuple[float, ...] = (2.0, 4.0)
    max_hint_log10_nfa: float = 0.0
    rotation_step_deg: float = 72.0

    def __post_init__(self) -> None:
        check_ranges(
            self,
            positive=(
                *("first_side_px", "max_side_px", "simulated_side_px", "min_first_inliers"),
                "min_first_depth_inliers",
                *("min_separation_px", "tilts", "rotation_step_deg"),
                *("homography_threshold_px", "fundamental_threshold_px", "first_max_keypoints"),
                *("simulated_max_keypoints", "min_points"),
            ),
            not_negative=("max_matches_to_search",),
            fractions=("max_ratios", "min_first_fraction", "max_first_parallax"),
            between={
                "max_log10_nfa": (-math.inf, 0),
                "max_hint_log10_nfa": (-math.inf, math.inf),
            },
        )

    def threshold_px(self, model: str) -> float:
        """Return the inlier threshold of a model."""
        homography = model == "homography"
        return self.homography_threshold_px if homography else self.fundamental_threshold_px


@suggest_keywords
@dataclass(frozen=True)
class VerificationOptions:
    """When two patches count as the same.

    Attributes:
        keypoint_sizes_px: diameters of the keypoints of the descriptors that are compared.
        lattice_px: between the points that are described, along rows and columns.
        false_positive_rate: fraction of null pairs (unrelated patches of the two images) that pass.
        smoothing_sigma_px: of the Gaussian mean over neighbouring points.
        window_px: side of the window around a point in which most points must pass, odd.
        min_support: fraction of the points in the window that must pass.
        null_shifts: shifts between the patches of a null pair, in shares of width and height.
        null_block_px: side of the blocks of the image that null pairs are taken from.
        max_null_blocks: at most this many blocks for each shift, chosen at random: all of them up
            to a megapixel.
        max_megapixels: larger images are compared at this size, which bounds memory and time.

    Raises:
        OptionError: a value is out of its range.
    """

    keypoint_sizes_px: tuple[float, ...] = (3.0, 8.0)
    lattice_px: int = 3
    false_positive_rate: float = 0.01
    smoothing_sigma_px: float = 2.5
    window_px: int = 101
    min_support: float = 0.5
    null_shifts: tuple[tuple[float, float], ...] = ((1 / 2, 0), (0, 1 / 2), (1 / 3, 1 / 3))
    null_block_px: int = 64
    max_null_blocks: int = 256
    max_megapixels: float = 6.0

    def __post_init__(self) -> None:
        check_ranges(
            self,
            positive=(
                *("keypoint_sizes_px", "lattice_px", "smoothing_sigma_px", "window_px"),
                *("null_block_px", "max_null_blocks", "max_megapixels"),
            ),
            fractions=("false_positive_rate", "min_support", "null_shifts"),
        )


@suggest_keywords
@dataclass(frozen=True)
class HomographyMatchingOptions:
    """How keypoints are matched by a homography.

    Attributes:
        max_side_px: longer sides are scaled down to this while the homography is refined.
        max_scale_ratio: of the two images; where one shows the scene finer by more than this, it is
            scaled down to the other for the refinement.
        refinement: how it is refined.
        max_distance_px: from where the homography takes a keypoint to its partner.
        min_proposed_fraction: where fewer of the keypoints that the second image shows under the
            homography have a partner there, keypoints are few, and all of them are verified.
        min_verified_fraction: this fraction of what is verified must be the same patches: with
            less, little of the scene lies on the plane.
        min_verified_fraction_of_depth: the same where matches off the plane agree on an epipole.
        min_parallax_fraction: as many must agree, relative to those on the plane.

    Raises:
        OptionError: a value is out of its range.
    """

    max_side_px: int = 1600
    max_scale_ratio: float = 1.5
    refinement: ValidatedRefinementOptions = field(default_factory=ValidatedRefinementOptions)
    max_distance_px: float = 1.0
    min_proposed_fraction: float = 0.25
    min_verified_fraction: float = 0.5
    min_verified_fraction_of_depth: float = 0.6
    min_parallax_fraction: float = 0.1

    def __post_init__(self) -> None:
        check_ranges(
            self,
            positive=("max_side_px", "max_distance_px"),
            between={"max_scale_ratio": (1, math.inf)},
            fractions=(
                *("min_verified_fraction", "min_verified_fraction_of_depth"),
                *("min_parallax_fraction", "min_proposed_fraction"),
            ),
        )


@suggest_keywords
@dataclass(frozen=True)
class RectifiedMatchingOptions:
    """How a pair is rectified by a fundamental matrix and its rows are matched.

    Attributes:
        frame: in which both images are rectified.
        disparity: how rows are matched; its range is found.
        max_volume: pixels of the frame times disparities; with more, the images are scaled down.
        tail_fraction: of the disparities of the sparse matches at each end, which may be wrong.
        margin_px, margin_fraction: added to the range of disparities at both ends, in pixels, and
            as a fraction of it.
        min_fraction_of_one_sign: where so many sparse matches grow about an epipole, or shrink,
            others do so by `margin_px` at most.
        correlation_window_px: side of the window in which both images are compared after matching,
            odd.
        correlation_sigma_px: of the blur before that.
        min_correlation: a match whose windows correlate less is left out, unless
            `false_discovery_rate` allows it.
        false_positive_rate: so many of the pixels may be matched by chance; matches whose windows
            correlate too little for that are left out. It is measured on rows that show something
            else.
        false_discovery_rate: while no more than this fraction of the matches is found by chance,
            the two bounds above hold only for the matches that geometry relies on.
        null_fraction: of the rows, which are matched with others for that.
        max_refits: the images are rectified again, by a matrix fitted to tracked corners, at most
            this often,
        max_row_error_px, row_quantile: where this fraction of them has its rows nearer than this to
            the lines of the new matrix, the old rows are good enough.
        max_range_excess: images that were scaled down are rectified again, too, where more was
            searched than this times the range of what was found.
        semi_calibrated: what the fit may assume of both cameras.
        min_sigma_px: a track or a sparse match is never counted as more exact than this.
        refit_corners: that are tracked.
        refit_window_px: side of the windows in which they are tracked, odd.
        max_round_trip_px: a track counts when it ends this near to its start, forth and back.
        max_track_px: a track that moves further than this from its match is wrong.
        min_tracks: that a matrix is estimated from; where fewer corners can be tracked to where
            they are matched, no match counts.
        max_disagreement_px: by which the disparity of a right sparse match, found in images of
            another scale, may differ.
        min_agreement: this fraction of the sparse matches must lie where the disparities say.

    Raises:
        OptionError: a value is out of its range.
    """

    frame: RectificationFrameOptions = field(default_factory=RectificationFrameOptions)
    disparity: DisparityOptions = field(
        default_factory=lambda: DisparityOptions(discontinuity_margin_px=1)
    )
    max_volume: float = 1e8
    tail_fraction: float = 0.01
    margin_px: float = 4.0
    margin_fraction: float = 0.25
    min_fraction_of_one_sign: float = 0.8
    correlation_window_px: int = 9
    correlation_sigma_px: float = 1.0
    min_correlation: float = 0.3
    false_positive_rate: float = 0.01
    false_discovery_rate: float = 0.01
    null_fraction: float = 0.25
    max_refits: int = 1
    max_row_error_px: float = 0.5
    row_quantile: float = 0.9
    max_range_excess: float = 1.25
    semi_calibrated: SemiCalibratedOptions = field(default_factory=SemiCalibratedOptions)
    min_sigma_px: float = 0.1
    refit_corners: int = 2000
    refit_window_px: int = 15
    max_round_trip_px: float = 0.3
    max_track_px: float = 4.0
    min_tracks: int = 50
    max_disagreement_px: float = 3.0
    min_agreement: float = 0.75

    def __post_init__(self) -> None:
        check_ranges(
            self,
            positive=(
                *("max_volume", "margin_px", "max_row_error_px", "refit_corners"),
                *("max_round_trip_px", "max_track_px", "correlation_sigma_px", "min_sigma_px"),
                "max_disagreement_px",
            ),
            not_negative=("max_refits", "margin_fraction"),
            fractions=(
                *("min_correlation", "min_fraction_of_one_sign"),
                *("false_positive_rate", "false_discovery_rate", "null_fraction"),
                *("row_quantile", "min_agreement"),
            ),
            odd=("correlation_window_px", "refit_window_px"),
            between={
                "tail_fraction": (0, 0.5),
                "min_tracks": (8, math.inf),
                "max_range_excess": (1, math.inf),
            },
        )


@suggest_keywords
@dataclass(frozen=True)
class GuidedOptions:
    """All tuned numbers of guided matching.

    Attributes:
        initial_geometry: the geometry that guides at first.
        homography_matching: planes and rotating cameras.
        rectified_matching: scenes with depth.
        verification: when two patches count as the same.
        min_matched_fraction: with a smaller fraction of the keypoints of a scene with depth
            matched, only the sparse matches that agree with its geometry are taken.
        min_matches: with fewer the geometry is not trusted after all.

    Raises:
        OptionError: a value is out of its range.
    """

    initial_geometry: InitialGeometryOptions = field(default_factory=InitialGeometryOptions)
    homography_matching: HomographyMatchingOptions = field(
        default_factory=HomographyMatchingOptions
    )
    rectified_matching: RectifiedMatchingOptions = field(default_factory=RectifiedMatchingOptions)
    verification: VerificationOptions = field(default_factory=VerificationOptions)
    min_matched_fraction: float = 0.02
    min_matches: int = 8

    def __post_init__(self) -> None:
        check_ranges(self, positive=("min_matches",), fractions=("min_matched_fraction",))
