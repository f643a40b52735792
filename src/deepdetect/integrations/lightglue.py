"""LightGlue: an extractor that replaces LightGlue's own SIFT extractor.

The features suit `LightGlue(features="sift")` of the packages lightglue and kornia. The weights of
LightGlue are not part of DeepDetect, and have licences of their own.
"""

from __future__ import annotations

from typing import Any, Literal

from .._shared.errors import OptionError, check_name, require_packages
from .._shared.options import suggest_keywords
from ..detector.point_detector import PointDetector
from ..features.keypoints import SIZES_PER_SCALE
from ..features.sift import ROOT_SIFT
from .tensors import load_tensor

require_packages("the drop-in for LightGlue", "torch")

from torch import Tensor
from torch.nn import Module

Scale = Literal["diameter", "sigma"]

MAX_KEYPOINTS = 4096
"""Maximum number of keypoints, as in LightGlue's own SIFT extractor, because LightGlue's time and
memory grow with the square of the number."""


class DeepDetectExtractor(Module):
    """A replacement for an extractor of LightGlue such as `lightglue.SIFT`.

    Args:
        detector: detector of at most 4,096 points with RootSIFT, for which LightGlue has weights.
        scale: what the tensor "scales" holds, "diameter" or "sigma"; see `Keypoints.to_lightglue`.

    Raises:
        OptionError: an option is unknown or out of its range.
    """

    @suggest_keywords
    def __init__(
        self,
        detector: PointDetector | None = None,
        *,
        scale: Scale = "diameter",
    ) -> None:
        if detector is None:
            detector = PointDetector(descriptor=ROOT_SIFT)
        super().__init__()
        if detector.descriptor_type != ROOT_SIFT:
            raise OptionError(
                f"LightGlue has no weights for {detector.descriptor_type} descriptors: give the "
                f"detector `descriptor={ROOT_SIFT!r}`"
            )
        if detector.max_keypoints is None or detector.max_keypoints > MAX_KEYPOINTS:
            raise OptionError(
                f"LightGlue takes up to {MAX_KEYPOINTS} keypoints, not "
                f"{detector.max_keypoints or 'all'}: give the detector a smaller `max_keypoints`"
            )
        check_name("scale", scale, SIZES_PER_SCALE)
        self._scale = scale
        self._detector = detector

    def extract(self, img: Any) -> dict[str, Tensor]:
        """Detect and describe keypoints.

        Args:
            img: RGB or grey tensor in [0, 1], (C, H, W) or (1, C, H, W); or anything that
                `load_image` accepts, such as a path.

        Returns:
            The tensors of `Keypoints.to_lightglue`, on the device of the image.

        Raises:
            ImageError: the image has a wrong shape, type or range, or is too small.
        """
        one = img[0] if getattr(img, "ndim", 0) == 4 and len(img) == 1 else img
        features = self._detector.extract(load_tensor(one)).to_lightglue(scale=self._scale)
        device = getattr(img, "device", "cpu")
        return {name: value.to(device) for name, value in features.items()}

    def forward(self, data: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the features of data["image"], as `extract` does."""
        return self.extract(data["image"])
