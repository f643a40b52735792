from __future__ import annotations

import pytest

from deepdetect import OptionError
from deepdetect.benchmark import Report, Section, Table
from deepdetect.benchmark.report import Column, Figure, joined


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


def test_reports_are_joined_in_order() -> None:
    reports = [
        Report(
            f"R{k}",
            {"machine": "m", f"only {k}": str(k)},
            (
                Section(
                    f"S{k}",
                    (),
                    (Table(f"t{k}", "T", (Column("a"),), ((k,),)),),
                    (Figure(f"f{k}", "F", b"png"),),
                ),
            ),
            (f"left {k}",),
        )
        for k in range(2)
    ]
    whole = joined("Both", reports)
    assert [table.key for table in whole.tables()] == ["t0", "t1"]
    assert [figure.key for figure in whole.figures()] == ["f0", "f1"]
    assert whole.left_out == ("left 0", "left 1")
    assert whole.origin == {"machine": "m", "only 0": "0", "only 1": "1"}
