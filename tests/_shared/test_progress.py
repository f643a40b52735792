"""How long stages take, and are expected to."""

from __future__ import annotations

from deepdetect._shared.progress import StageTimer


def test_what_is_left_follows_the_pace_of_what_has_ended() -> None:
    timer = StageTimer()
    assert timer.left == 0
    timer.expected = {"features": 1, "matching": 3, "mapping": 8}
    assert timer.left == 12
    timer.seconds = {"features": 2, "matching": 4, "more": 100}
    assert timer.left == 8 * 6 / 4
    timer.seconds["mapping"] = 1
    assert timer.left == 0
