from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from deepdetect._shared.text_files import read_json, read_toml

READERS = {
    "JSON": (read_json, '{"a": [1, "ä"]}'),
    "TOML": (read_toml, 'a = [1, "ä"]'),
}


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
@pytest.mark.parametrize("kind", READERS)
def test_files_with_and_without_a_byte_order_mark(kind: str, mark: bytes, tmp_path: Path) -> None:
    read, text = READERS[kind]
    path = tmp_path / "file"
    path.write_bytes(mark + text.encode())
    assert read(path, 20) == {"a": [1, "ä"]}


@pytest.mark.parametrize("content", [b"\n" * 101, b"a = " + b"[" * 90, b"\xff", b"{"])
@pytest.mark.parametrize("read", [read_json, read_toml])
def test_other_files_are_a_value_error(
    read: Callable[[Path, int], Any], content: bytes, tmp_path: Path
) -> None:
    path = tmp_path / "file"
    path.write_bytes(content)
    with pytest.raises(ValueError):  # noqa: PT011 - of several kinds
        read(path, 100)


@pytest.mark.parametrize(("read", "start"), [(read_json, ""), (read_toml, "a = ")])
def test_deep_nesting_is_a_value_error(
    read: Callable[[Path, int], Any], start: str, tmp_path: Path
) -> None:
    path = tmp_path / "file"
    path.write_text(start + "[" * 100_000)
    with pytest.raises(ValueError, match="nested too deep"):
        read(path, 200_000)
