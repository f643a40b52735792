"""How commands take options from signatures, name results, and print them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from deepdetect import DeepDetectError, OptionError
from deepdetect._shared.errors import BatchError
from deepdetect.cli import _options as options


@dataclass(frozen=True)
class Sizes:
    """Sizes.

    Attributes:
        width: in pixels. More of it.
        tall: whether it is high.
    """

    width: int = 3
    tall: bool = True


def test_options_are_those_of_a_signature() -> None:
    source = options.From(Sizes, "width", flags={"tall": "--tall/--no-tall --flat"})

    @options.command(source)
    def show(path: Path, **values: object) -> options.Result:
        return options.Result({"path": str(path), **values})

    parameters = show.__signature__.parameters
    assert list(parameters) == ["path", "as_json", "width", "tall"]
    assert parameters["width"].default == 3
    given, setting = parameters["width"].annotation.__metadata__[0], parameters["tall"].annotation
    assert given.help == "In pixels."
    assert setting.__metadata__[0].negative == ("--no-tall", "--flat")
    values = {"width": 4, "other": 1}
    assert source.take(values) == {"width": 4}
    assert values == {"other": 1}


def test_a_result_is_printed_or_is_the_error(capsys: pytest.CaptureFixture[str]) -> None:
    found = options.Result({"a": 1, "b": [1, 2]}, exit_code=3)
    assert found.show(as_json=True) == 3
    assert json.loads(capsys.readouterr().out) == {"a": 1, "b": [1, 2]}
    with pytest.raises(BatchError, match="1 of 2 images"):
        options.Result({}, "text", ["x.png is bad"], 2).show(as_json=False)
    with pytest.raises(DeepDetectError, match=r"^x\.png is bad$"):
        options.Result({}, "text", ["x.png is bad"], 1).show(as_json=False)


def test_results_are_named_by_o_and_by_their_images(tmp_path: Path) -> None:
    assert options.output_file(tmp_path, "model.ply") == tmp_path / "model.ply"
    assert options.output_file(Path("rec"), "model.ply") == Path("rec/model.ply")
    assert options.output_file(Path("rec/scene.glb"), "model.ply") == Path("rec/scene.glb")
    assert options.output_folder(Path("run.2")) == Path("run.2")
    with pytest.raises(OptionError):
        options.output_folder(Path("points.npz"))
    both = {"data": ".npz", "picture": ".jpg"}
    files = options.output_files(Path("out"), "a", both)
    assert files == {"data": Path("out/a.npz"), "picture": Path("out/a.jpg")}
    assert options.output_files(Path("m.csv"), "a", {"data": ".csv"}) == {"data": Path("m.csv")}
    images = {name: Path(name) for name in ("a.jpg", "a.png", "b/c.png")}
    assert [*options.result_stems(images).values()] == ["a.jpg", "a.png", "b/c"]


def test_no_file_is_written_twice_or_over_an_input(tmp_path: Path) -> None:
    image, link = tmp_path / "image.png", tmp_path / "link.png"
    image.touch()
    link.symlink_to(image)
    options.check_outputs([tmp_path / "a", tmp_path / "b"], [image])
    for outputs in ([link], [tmp_path / "a", tmp_path / "a"]):
        with pytest.raises(OptionError):
            options.check_outputs(outputs, [image])
    with pytest.raises(ZeroDivisionError), options.whole({"a": tmp_path / "a"}) as files:
        files["a"].write_text(str(1 / 0))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["image.png", "link.png"]


def test_a_table_has_a_column_for_each() -> None:
    text = options.table({"a": 0.123456789, "b c": {"d": 12345}, "e": None}, {"a": True})
    assert [line.split() for line in text.splitlines()] == [
        ["a", "0.123457", "yes"],
        ["b", "c:", "d", "12,345", "-"],
    ]
