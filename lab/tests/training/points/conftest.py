from __future__ import annotations

import numpy as np
import pytest

from ..conftest import texture


@pytest.fixture
def photo() -> np.ndarray:
    """A picture of random blobs, (320, 320) uint8."""
    return texture(7, 320)
