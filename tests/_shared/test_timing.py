from __future__ import annotations

import pytest

from deepdetect._shared.timing import StageTimer


def test_stages_are_reported_in_the_order_in_which_they_end() -> None:
    reported: list[str] = []
    timer = StageTimer(reported.append)
    with timer.stage("outer"), timer.stage("inner"):
        assert reported == []
    assert reported == ["inner", "outer"] == list(timer.seconds)
    assert timer.seconds["outer"] >= timer.seconds["inner"] >= 0


def test_a_stage_that_fails_is_not_reported() -> None:
    timer = StageTimer(lambda name: pytest.fail(f"{name} was reported"))
    with pytest.raises(KeyError), timer.stage("matching"):
        raise KeyError
    assert timer.seconds == {}
