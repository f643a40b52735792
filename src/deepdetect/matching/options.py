"""Named sets of matching options: one line each."""

from __future__ import annotations

from dataclasses import dataclass, field

from .._shared.errors import OptionError, unknown_name
from .._shared.options import suggest_keywords
from .._shared.registry import look_up
from ..detector.heatmap import HeatmapOptions
from ..features.matchers import get_matcher
from ..features.selection import SelectionOptions
from ..features.sift import get_descriptor
from ..geometry import GeometryOptions
from .guided import GuidedOptions

GUIDES = ("auto", "homography", "fundamental")

GUIDES_OF_MODELS = {
    "homography": "homography",
    "fundamental": "fundamental",
    "essential": "fundamental",
}
"""The geometry that guides for each `model`; the other models leave it open."""

UNGUIDED_ONLY = ("descriptor", "keypoint_size", "angle", "matcher", "ratio")
"""Options of `MatchingOptions` that do not apply to guided matches."""


@suggest_keywords
@dataclass(frozen=True, eq=False)
class MatchingOptions:
    """How two images are matched.

    Those of `UNGUIDED_ONLY` (descriptor, keypoint_size, angle, matcher, ratio) apply only to
    matches by descriptors alone, with `guided=False`.

    Attributes:
        heatmap: how the network sees the images; None leaves the detector's own way.
        selection: which pixels become keypoints.
        descriptor: "sift", "rootsift", or "sift-opencv" for OpenCV's own in any case.
        keypoint_size: diameter of a keypoint for its descriptor, in pixels (paper: 3).
        angle: direction of all keypoints in degrees; -1 is OpenCV's "unset".
        matcher: "auto" ("exact" for few keypoints, else "patchmatch" for dense ones and "flann" for
            others), "flann", "exact", "faiss" or "patchmatch" ("hamming" is for binary
            descriptors).
        ratio: the ratio test keeps matches strictly under it (paper's code: 0.99).
        mutual: keep only pairs that are each other's nearest; guided, of those that share a
            keypoint of the second image only the best, and swapped images give the same matches.
        guided: whether a geometry from a few matches guides the matching; else the matcher alone
            decides.
        guide: which one: "homography", "fundamental", or "auto": the one that fits
            `geometry.model`, and for the models "auto" and "none" the one that fits the images.
        geometry: which geometry is estimated in the end, and how.
        guided_options: all tuned numbers of guided matching.

    Raises:
        OptionError: a name is unknown, a value out of its range, or the guide contradicts the
            model.
    """

    heatmap: HeatmapOptions | None = None
    selection: SelectionOptions = field(default_factory=SelectionOptions)
    descriptor: str = "sift"
    keypoint_size: float = 3.0
    angle: float = 0.0
    matcher: str = "flann"
    ratio: float = 0.99
    mutual: bool = False
    guided: bool = True
    guide: str = "auto"
    geometry: GeometryOptions = field(default_factory=lambda: GeometryOptions(model="auto"))
    guided_options: GuidedOptions = field(default_factory=GuidedOptions)

    def __post_init__(self) -> None:
        get_descriptor(self.descriptor)
        get_matcher(self.matcher)
        if self.matcher == "hamming":
            raise OptionError(
                "the matcher hamming compares binary descriptors, as ORB's: take exact or flann"
            )
        if self.guide not in GUIDES:
            raise unknown_name("guide", self.guide, GUIDES)
        fitting = GUIDES_OF_MODELS.get(self.geometry.model, self.guide)
        if self.guide not in ("auto", fitting):
            raise OptionError(
                f"the guide {self.guide} contradicts the model {self.geometry.model}: "
                "leave one of them out"
            )
        if not 0 < self.keypoint_size <= 100:
            raise OptionError(
                f"`keypoint_size` must be above 0 and at most 100 pixels, not {self.keypoint_size}"
            )
        if self.angle != -1 and not 0 <= self.angle < 360:
            raise OptionError(f"the angle must lie in [0, 360) or be -1, not {self.angle}")
        if not 0 < self.ratio <= 1:
            raise OptionError(f"the ratio must be above 0 and at most 1, not {self.ratio}")

    @property
    def guiding_model(self) -> str:
        """The geometry that guides: a plane would drop what is off it, so `model` decides."""
        if self.guide != "auto":
            return self.guide
        return GUIDES_OF_MODELS.get(self.geometry.model, "auto")


PRESETS: dict[str, MatchingOptions] = {
    "default": MatchingOptions(),
    # What the authors' published code runs: BGR although the weights were trained on
    # RGB, the angle unset, and every match evaluated by the true homography.
    "published": MatchingOptions(
        heatmap=HeatmapOptions(resolution=480, network_channels="bgr"),
        selection=SelectionOptions(threshold=0.5, mode="dense"),
        descriptor="sift",
        keypoint_size=3.0,
        angle=-1.0,
        matcher="flann",
        ratio=0.99,
        guided=False,
        geometry=GeometryOptions(model="none"),
    ),
}


def get_preset(name: str) -> MatchingOptions:
    """Look a preset up.

    Raises:
        OptionError: the name is unknown.
    """
    return look_up("preset", name, PRESETS)
