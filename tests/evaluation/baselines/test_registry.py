from __future__ import annotations

import pytest

from deepdetect import OptionError, WeightsError
from deepdetect.evaluation.baselines import CLASSICAL, find_method


def test_there_are_seven_methods_with_two_settings_each() -> None:
    kinds = {"sift", "orb", "brisk", "fast", "agast", "harris", "shi-tomasi"}
    assert set(CLASSICAL) == kinds | {f"{kind}-low" for kind in kinds}
    assert len({method.title for method in CLASSICAL.values()}) == 14
    assert all(find_method(name) is method for name, method in CLASSICAL.items())


@pytest.mark.parametrize(
    ("word", "nearest"),
    [("siift", "sift"), ("SIFT", "sift"), ("fast_low", "fast-low"), ("shitomasi", "shi-tomasi")],
)
def test_an_unknown_word_brings_the_nearest_and_the_other_ways(
    word: str, nearest: str, one_line
) -> None:
    with pytest.raises(OptionError) as caught:
        find_method(word)
    message = one_line(caught.value)
    assert f"did you mean {nearest!r}" in message
    assert "ONNX" in message
    assert "package.module:function" in message


def test_a_word_is_a_file_by_its_ending_and_a_function_by_its_colon() -> None:
    with pytest.raises(WeightsError, match="cannot be read"):
        find_method("folder:of/none.onnx")
    with pytest.raises(OptionError, match="cannot be imported"):
        find_method("no_such_package:function")
