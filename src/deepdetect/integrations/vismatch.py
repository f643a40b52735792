"""vismatch (image-matching-models): a matcher of two images."""

from __future__ import annotations

from typing import Any

import numpy as np

from .._shared.errors import require_packages
from ..detector.detector import AnyDetector, DeepDetect
from ..detector.point_detector import PointDetector
from ..matching.pipeline import match_images
from .tensors import load_tensor

require_packages("the drop-in for vismatch", "vismatch", "torch")

from torch import Tensor
from vismatch import BaseMatcher


class DeepDetectMatcher(BaseMatcher):
    """Guided matches of two images, as one of vismatch's matchers.

    Call it as these: `DeepDetectMatcher()(image0, image1)`. The confidences are our scores; there
    are no descriptors, as guided matches compare patches.

    Args:
        device: where the images are; the matching itself runs on the processor.
        max_num_keypoints: at most this many, the best of all scales; None: dense keypoints.
        weights: of dense keypoints, as of `DeepDetect`.
        **keywords: of vismatch: `ransac_iters`, `ransac_conf`, `ransac_reproj_thresh`.

    Raises:
        OptionError: an option is unknown or out of its range.
    """

    def __init__(
        self,
        device: str = "cpu",
        max_num_keypoints: int | None = 2048,
        *,
        weights: str = "default",
        **keywords: Any,
    ) -> None:
        super().__init__(device, **keywords)
        self._detector: AnyDetector = (
            DeepDetect(weights) if max_num_keypoints is None else PointDetector(max_num_keypoints)
        )

    def _forward(
        self, img0: Tensor, img1: Tensor
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, None, None, np.ndarray]:
        """Return matched points, all keypoints, no descriptors, and the scores of the matches."""
        matches = match_images(load_tensor(img0), load_tensor(img1), self._detector)
        all0, all1 = matches.keypoints0.xy, matches.keypoints1.xy
        return matches.points0, matches.points1, all0, all1, None, None, matches.scores
