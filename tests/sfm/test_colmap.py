from __future__ import annotations

import sys

import pytest

from deepdetect.sfm.colmap import quiet_pycolmap


def test_what_pycolmap_logs_is_not_seen(pycolmap, capfd: pytest.CaptureFixture[str]) -> None:
    pycolmap.logging.warning("loud")
    assert "loud" in capfd.readouterr().err
    with quiet_pycolmap() as found:
        assert found is pycolmap
        found.logging.warning("quiet")
        print("a bar", file=sys.stderr)
    pycolmap.logging.warning("loud again")
    shown = capfd.readouterr().err
    assert "quiet" not in shown
    assert "a bar" in shown
    assert "loud again" in shown


def test_errors_leave_standard_error_as_it_was(pycolmap, capfd: pytest.CaptureFixture[str]) -> None:
    before = sys.stderr
    with pytest.raises(ZeroDivisionError), quiet_pycolmap():
        raise ZeroDivisionError
    assert sys.stderr is before
    print("still there", file=sys.stderr)
    assert "still there" in capfd.readouterr().err
