from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetectError, OptionError
from deepdetect.tracking import TrackedFrame, load_tracks
from deepdetect.tracking.tracks import TrackDrawer, track_color, write_tracks


def frame(number: int, tracks: list[int], ages: list[int]) -> TrackedFrame:
    xy = np.array([[10 * track + 0.25, number] for track in tracks], np.float32).reshape(-1, 2)
    return TrackedFrame(
        number, np.array(tracks), xy, np.full(len(tracks), 0.5, np.float32), np.array(ages)
    )


def test_the_table_is_read_by_other_programs_and_by_us(tmp_path: Path) -> None:
    frames = [frame(0, [0, 1], [0, 0]), frame(2, [1, 4], [1, 0]), frame(4, [4], [1])]
    with write_tracks(tmp_path / "t.csv") as write:
        for each in frames:
            write(each)
    with (tmp_path / "t.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert rows[2] == {"frame": "2", "track": "1", "x": "10.250", "y": "2.000", "score": "0.5"}
    assert len(rows) == 5
    for one, other in zip(load_tracks(tmp_path / "t.csv"), frames, strict=True):
        assert one.number == other.number
        for name in ("tracks", "xy", "scores", "ages"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "x,y\n1,2\n",
        "frame,track,x,y,score\n" + "1,2,3\n" * 5,
        "frame,track,x,y,score\n0,1,nan,2,3\n",
    ],
)
def test_another_file_is_one_sentence(text: str, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(DeepDetectError, match=r"t\.csv"):
        load_tracks(tmp_path / "t.csv")


def test_a_table_is_whole_or_not_there(tmp_path: Path) -> None:
    def stopped() -> None:
        with write_tracks(tmp_path / "t.csv") as write:
            write(frame(0, [0], [0]))
            raise RuntimeError

    with pytest.raises(RuntimeError):
        stopped()
    assert not list(tmp_path.iterdir())
    with pytest.raises(OptionError), write_tracks(tmp_path / "t.txt"):
        pass
    with write_tracks(tmp_path / "t.csv"):
        pass
    assert load_tracks(tmp_path / "t.csv") == []


def test_shapes_are_checked() -> None:
    with pytest.raises(OptionError):
        TrackedFrame(0, np.arange(2), np.zeros((3, 2)), np.zeros(2), np.zeros(2))


def test_tracks_are_drawn_where_they_are() -> None:
    black = np.zeros((60, 80, 3), np.uint8)
    drawer = TrackDrawer(tail=3)
    drawn = black
    for k, x in enumerate((20.0, 30.0, 40.0)):
        frame = TrackedFrame(k, np.array([5]), np.array([[x, 30]]), np.ones(1), np.array([k]))
        drawn = drawer.draw(black, frame)
    color = np.array(track_color(5), float)
    for x in (20, 30, 40):  # lines are blended with what is below
        seen = drawn[30, x].astype(float)
        assert seen.max() > 120
        np.testing.assert_allclose(seen / seen.max(), color / color.max(), atol=0.05)
    assert not drawn[50:].any()
    assert not black.any()
    assert drawer.draw(black, frame, "12 frames/s").astype(int).sum() > drawn.astype(int).sum()
