from __future__ import annotations

import numpy as np
import pytest

from deepdetect.io.notes import worded


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1234567, "1,234,567"),
        (np.int64(1200), "1,200"),
        (49979.0, "49,979"),
        (np.float32(0.95312), "0.9531"),
        (float("nan"), "nan"),
        (True, "True"),
        ("  two\n lines ", "two lines"),
    ],
)
def test_values_become_one_line(value: object, text: str) -> None:
    assert worded({"a\nname": value}) == {"a name": text}
