"""Named sets of matching options: one line each."""

from __future__ import annotations

from dataclasses import dataclass, field

from .._shared.errors import OptionError, look_up, unknown_name
from ..detector.heatmap import HeatmapOptions
from ..features.descriptors import get_descriptor
from ..features.keypoints import SelectionOptions
from ..features.matchers import get_matcher
from ..geometry import GeometryOptions
from .guided import GUIDANCES

UNGUIDED_ONLY = ("descriptor", "keypoint_size", "angle", "matcher", "ratio")
"""Options of `MatchingOptions` that have no say in matches that a geometry guided."""


@dataclass(frozen=True, eq=False)
class MatchingOptions:
    """How two images are matched.

    Those of `UNGUIDED_ONLY` (descriptor, keypoint_size, angle, matcher, ratio) have a say only in
    unguided matching: with the guidance "none", or where no geometry can be trusted.

    Attributes:
        heatmap: how the network sees the images; None leaves the detector's own way.
        selection: which pixels become keypoints.
        descriptor: "sift", "rootsift", or "sift-opencv" for OpenCV's own in any case.
        keypoint_size: diameter of a keypoint for its descriptor, in pixels (paper: 3).
        angle: direction of all keypoints in degrees; -1 is OpenCV's "unset".
        matcher: "flann", "exact", "faiss" or "patchmatch" ("hamming" is for binary
            descriptors).
        ratio: the ratio test keeps matches strictly under it (paper's code: 0.99).
        mutual: keep only pairs that are each other's nearest; guided, of those that share a
            keypoint of the second image only the one with the smallest ratio.
        guidance: "auto", "homography" or "fundamental": a geometry from few points proposes the
            matches; "auto" chooses which (`guidance.guided`), but takes the one that `model` asks
            for. "none": the matcher alone.
        geometry: which geometry is estimated, and how.

    Raises:
        OptionError: a name is unknown or a value out of its range.
    """

    heatmap: HeatmapOptions | None = None
    selection: SelectionOptions = field(default_factory=SelectionOptions)
    descriptor: str = "sift"
    keypoint_size: float = 3.0
    angle: float = 0.0
    matcher: str = "flann"
    ratio: float = 0.99
    mutual: bool = False
    guidance: str = "auto"
    geometry: GeometryOptions = field(default_factory=lambda: GeometryOptions(model="auto"))

    def __post_init__(self) -> None:
        get_descriptor(self.descriptor)
        get_matcher(self.matcher)
        if self.matcher == "hamming":
            raise OptionError(
                "the matcher hamming compares binary descriptors, as ORB's: take exact or flann"
            )
        if self.guidance not in GUIDANCES:
            raise unknown_name("guidance", self.guidance, GUIDANCES)
        if not 0 < self.keypoint_size <= 100:
            raise OptionError(
                f"the keypoint size must be above 0 and at most 100 pixels, "
                f"not {self.keypoint_size}"
            )
        if self.angle != -1 and not 0 <= self.angle < 360:
            raise OptionError(f"the angle must lie in [0, 360) or be -1, not {self.angle}")
        if not 0 < self.ratio <= 1:
            raise OptionError(f"the ratio must be above 0 and at most 1, not {self.ratio}")


PRESETS: dict[str, MatchingOptions] = {
    "default": MatchingOptions(),
    # What the authors' published code runs: BGR although the weights were trained on
    # RGB, the angle unset, and every match judged by the true homography.
    "published": MatchingOptions(
        heatmap=HeatmapOptions(resolution=480, channels="bgr"),
        selection=SelectionOptions(threshold=0.5),
        descriptor="sift",
        keypoint_size=3.0,
        angle=-1.0,
        matcher="flann",
        ratio=0.99,
        guidance="none",
        geometry=GeometryOptions(model="none"),
    ),
}


def get_preset(name: str) -> MatchingOptions:
    """Look a preset up.

    Raises:
        OptionError: the name is unknown.
    """
    return look_up("preset", name, PRESETS)
