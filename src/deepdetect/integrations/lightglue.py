"""LightGlue: features of an image as its SIFT extractor gives them.

They fit `LightGlue(features="sift")` of the package lightglue, and of kornia, whose weights are not
ours; see their licences.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from .._shared.errors import OptionError, unknown_name
from .._shared.options import suggest_keywords
from ..detector.point_detector import PointDetector
from ..features.keypoints import Keypoints
from ..features.scale_space import SIZE_PER_SIGMA
from ..io.image import load_image
from .packages import base_class
from .tensors import image_from_tensor

if TYPE_CHECKING:
    from torch import Tensor
    from torch.nn import Module
else:
    Module = base_class("torch.nn", "Module")

Scale = Literal["diameter", "sigma"]
SCALES = ("diameter", "sigma")

MAX_KEYPOINTS = 4096
"""Its time and memory grow with the square of their number; so many its SIFT extractor takes."""


def to_lightglue(points: Keypoints, scale: Scale = "diameter") -> dict[str, Tensor]:
    """Convert described keypoints to the features of one image that LightGlue takes.

    It is `Keypoints.to_lightglue` of keypoints that have all that LightGlue's weights want.

    Args:
        points: with sizes, angles and descriptors.
        scale: what its scales are: "diameter", as its own extractor has them from OpenCV, or
            "sigma", half of it, as it has them from COLMAP, and as kornia's `LightGlueMatcher`
            gives them. Both authors' programs use the same weights.

    Returns:
        Float32 tensors: "keypoints" (1, N, 2) in pixels, "keypoint_scores" (1, N), "descriptors"
        (1, N, D) of length 1, "scales" (1, N) in pixels, "oris" (1, N) in radians from x towards y,
        and "image_size" (1, 2), width first.

    Raises:
        OptionError: the keypoints lack sizes, angles or descriptors, or the scale is unknown.
        MissingExtraError: torch is not installed.
    """
    if scale not in SCALES:
        raise unknown_name("scale", scale, SCALES)
    if points.sizes is None or points.angles is None or points.descriptors is None:
        raise OptionError("LightGlue needs keypoints with sizes, angles and descriptors")
    features: dict[str, Tensor] = points.to_lightglue()
    if scale == "sigma":
        features["scales"] = features["scales"] / SIZE_PER_SIGMA
    return features


class DeepDetectExtractor(Module):
    """Takes the place of an extractor of LightGlue, as `lightglue.SIFT`.

    Args:
        detector: of the points; LightGlue takes up to 4,096.
        scale: as of `to_lightglue`.

    Raises:
        OptionError: an option is unknown or out of its range.
        MissingExtraError: torch is not installed.
    """

    @suggest_keywords
    def __init__(
        self,
        detector: PointDetector = PointDetector(),
        *,
        scale: Scale = "diameter",
    ) -> None:
        super().__init__()
        if detector.max_keypoints is None or detector.max_keypoints > MAX_KEYPOINTS:
            raise OptionError(
                f"LightGlue takes up to {MAX_KEYPOINTS} keypoints, not "
                f"{detector.max_keypoints or 'all'}: give the detector a smaller `max_keypoints`"
            )
        if scale not in SCALES:
            raise unknown_name("scale", scale, SCALES)
        self._scale = scale
        self._detector = detector

    def extract(self, img: Any) -> dict[str, Tensor]:
        """Find and describe keypoints.

        Args:
            img: (3, H, W), (1, H, W) or (1, C, H, W) tensor in [0, 1], RGB; or anything
                `load_image` takes, as a path.

        Returns:
            As of `to_lightglue`, on the device of the image.

        Raises:
            ImageError: the image is not fit.
        """
        import torch

        if not isinstance(img, torch.Tensor):
            return to_lightglue(self._detector.extract(load_image(img)), self._scale)
        if img.ndim == 4 and len(img) != 1:
            raise OptionError(f"extract takes one image, not {len(img)}: call it for each")
        rgb = image_from_tensor(img[0] if img.ndim == 4 else img)
        features = to_lightglue(self._detector.extract(rgb), self._scale)
        return {name: value.to(img.device) for name, value in features.items()}

    def forward(self, data: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the features of data["image"], as of `extract`."""
        return self.extract(data["image"])
