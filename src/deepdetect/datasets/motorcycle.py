"""The Motorcycle pair of Middlebury 2014, which lies inside scikit-image's wheel."""

from __future__ import annotations

import numpy as np

from .._shared.errors import MissingExtraError
from .stereo import StereoPair


def load_motorcycle() -> StereoPair:
    """Load both views (741x500) and the true disparity, without network access.

    Raises:
        MissingExtraError: scikit-image is not installed.
    """
    try:
        from skimage import data
    except ImportError:
        raise MissingExtraError(
            "the Motorcycle pair needs the package scikit-image, which is not installed: "
            "run pip install scikit-image"
        ) from None
    left, right, disparity = data.stereo_motorcycle()
    disparity = np.asarray(disparity, np.float32).squeeze()
    unknown = ~np.isfinite(disparity)
    return StereoPair("motorcycle", left, right, np.where(unknown, np.nan, disparity))
