"""How two images are matched: the options of `match_images`."""

from __future__ import annotations

from dataclasses import dataclass, field

from .._shared.errors import OptionError, unknown_name
from .._shared.options import check_ranges, suggest_keywords
from ..features.matchers import get_matcher
from ..features.sift import get_descriptor
from ..geometry import GeometryOptions

TWO_VIEW_MODELS = ("auto", "homography", "fundamental")

UNGUIDED_ONLY = ("descriptor", "keypoint_size", "angle", "matcher", "ratio")
"""Options of `MatchingOptions` that do not apply to guided matching."""


@suggest_keywords
@dataclass(frozen=True, eq=False)
class MatchingOptions:
    """How two images are matched.

    Those of `UNGUIDED_ONLY` (descriptor, keypoint_size, angle, matcher, ratio) apply only to
    matches by descriptors alone, with `guided_matching=False`.

    Attributes:
        two_view_model: the geometry that guides where `model` leaves it open: "homography",
            "fundamental", or "auto": the one that fits the images.
        descriptor: "sift", "rootsift", or "sift-opencv" for OpenCV's own in any case.
        keypoint_size: diameter of a keypoint for its descriptor, in pixels (paper: 3). Keypoints
            with sizes and angles of their own are described at these.
        angle: direction of all keypoints in degrees; -1 is OpenCV's "unset".
        matcher: "auto" ("exact" for few keypoints, else "patchmatch" for dense ones and "flann" for
            others), "flann", "exact", "faiss" or "patchmatch" ("hamming" is for binary
            descriptors).
        ratio: the ratio test keeps matches strictly under it (paper's code: 0.99).
        geometry: how the geometry is estimated in the end.

    Raises:
        OptionError: a name is unknown, or a value out of its range.
    """

    two_view_model: str = "auto"
    descriptor: str = "sift"
    keypoint_size: float = 3.0
    angle: float = 0.0
    matcher: str = "flann"
    ratio: float = 0.99
    geometry: GeometryOptions = field(default_factory=GeometryOptions)

    def __post_init__(self) -> None:
        get_descriptor(self.descriptor)
        get_matcher(self.matcher)
        if self.matcher == "hamming":
            raise OptionError(
                "the matcher hamming compares binary descriptors, as ORB's: take exact or flann"
            )
        if self.two_view_model not in TWO_VIEW_MODELS:
            raise unknown_name("two-view model", self.two_view_model, TWO_VIEW_MODELS)
        if self.angle != -1 and not 0 <= self.angle < 360:
            raise OptionError(f"the angle must lie in [0, 360) or be -1, not {self.angle}")
        limits = {"keypoint_size": (0, 100), "ratio": (0, 1)}
        check_ranges(self, positive=tuple(limits), between=limits)


PUBLISHED_MATCHING = MatchingOptions(angle=-1.0, ratio=0.99, matcher="flann")
"""What the authors' published code runs, with `DeepDetect(resolution=480, network_channels="bgr")`
(BGR although the weights were trained on RGB), `guided_matching=False` and `model="none"`: every
match is evaluated by the true homography."""
