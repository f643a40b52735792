from __future__ import annotations

import inspect
from collections.abc import Iterator

import click
import pytest
from click.testing import CliRunner

from deepdetect.cli import main
from deepdetect.cli.main import OLD_FLAGS, with_flags


def commands(command: click.Command, words: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Yield every command's words, those of groups among them."""
    yield words
    if isinstance(command, click.Group):
        for name, each in command.commands.items():
            yield from commands(each, (*words, name))


def command_of(words: tuple[str, ...]) -> click.Command:
    command: click.Command = main
    for word in words:
        assert isinstance(command, click.Group)
        command = command.commands[word]
    return command


@pytest.mark.parametrize("words", list(commands(main)), ids=" ".join)
def test_the_help_shows_examples_line_by_line(words: tuple[str, ...]) -> None:
    result = CliRunner().invoke(main, [*words, "--help"])
    assert result.exit_code == 0
    assert "\\b" not in result.output, "the mark that keeps click from wrapping is not seen"
    lines = {line.strip() for line in result.output.splitlines()}
    text = inspect.cleandoc(command_of(words).help or "")
    examples = [line.strip() for line in text.splitlines() if line.startswith("deepdetect ")]
    for example in examples:
        assert example in lines
    if words and not isinstance(command_of(words), click.Group) and words != ("demo",):
        assert examples or words == ("datasets", "list"), "a newcomer wants an example"


@pytest.mark.parametrize("words", list(commands(main)), ids=" ".join)
def test_every_option_says_what_it_is(words: tuple[str, ...]) -> None:
    for parameter in command_of(words).params:
        if isinstance(parameter, click.Option) and parameter.name not in ("help", "version"):
            assert parameter.help, parameter.name


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("give `focal_px` or `calibration`", "give --focal or --calibration"),
        ("give `rectified=False`", "give --not-rectified"),
        ("give `rectified=True`", "give --rectified"),
        ('use `backend="torch"`', "use --backend torch"),
        ("use `no_such_option`, `LEFT`", "use no_such_option, LEFT"),
        ("focal_px must be above 0", "--focal must be above 0"),
        ('there is no "focal_px" in my_focal_px.json, focal_px.json', None),
    ],
)
def test_errors_name_flags_instead_of_parameters(message: str, expected: str | None) -> None:
    assert with_flags(message, main.commands["reconstruct"]) == (expected or message)


@pytest.mark.parametrize(
    ("arguments", "right"),
    [
        ("benchmark oxford --only sift", "--baselines"),
        ("benchmark oxford --baselnes sift", "--baselines"),
        ("evaluate samples --against other.onnx", "--compare"),
        ("evaluate samples --comparee other.onnx", "--compare"),
        ("reconstruct a.png b.png --calib c.json", "--calibration"),
        ("train photographs --loaders 2", "--num-workers"),
    ],
)
def test_an_old_or_misspelt_flag_names_the_right_one(arguments: str, right: str) -> None:
    result = CliRunner().invoke(main, arguments.split())
    assert result.exit_code == 2
    assert f"'{right}'" in result.stderr or f"{right}?" in result.stderr, result.stderr


def test_every_old_flag_has_a_new_one() -> None:
    flags = {
        o
        for c in main.commands.values()
        for p in c.get_params(click.Context(c))
        for o in (*p.opts, *p.secondary_opts)
    }
    assert set(OLD_FLAGS.values()) <= flags
    assert not set(OLD_FLAGS) & flags
