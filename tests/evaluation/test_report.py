from __future__ import annotations

import pytest

from deepdetect import OptionError
from deepdetect.evaluation.protocols import Table
from deepdetect.evaluation.report import Column


@pytest.mark.parametrize(
    ("style", "cell", "text"),
    [
        (".3f", 0.5, "0.500"),
        (".2%", 0.12345, "12.35%"),
        (",d", 1234567, "1,234,567"),
        (",d", 0, "0"),
        (",.0f", 1234.5, "1,234"),
        ("", "name", "name"),
        (",d", "as text", "as text"),
        (".3f", None, "–"),
        (",d", None, "–"),
        (".3f", float("nan"), "–"),
        (".3f", float("inf"), "inf"),
    ],
)
def test_cells_are_written_in_the_style_of_their_column(style: str, cell, text: str) -> None:
    assert Column("title", style).show(cell) == text


def test_a_row_of_another_length_is_an_error(one_line) -> None:
    columns = (Column("a"), Column("b"))
    with pytest.raises(OptionError, match="table key has 1 cells for 2 columns") as caught:
        Table("key", "Title", columns, ((1, 2), (1,)))
    one_line(caught.value)


def test_two_columns_of_one_title_are_refused(one_line) -> None:
    """Rows become dicts by title in the JSON."""
    with pytest.raises(OptionError, match="share a title") as caught:
        Table("t", "T", (Column("a"), Column("a")), ())
    one_line(caught.value)
