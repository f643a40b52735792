from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import click
import pytest
from click.testing import CliRunner

from deepdetect.cli import _generated
from deepdetect.cli._generated import FieldOptions, generated_command, given_only


@dataclass(frozen=True)
class Options:
    """Some options.

    Attributes:
        count: how many. A second sentence is not shown.
        ratio, share: numbers
            on two lines.
        mode: how.
        sizes: several sizes.
        quick: whether it is quick.
        folder: where; None: nowhere.
        hidden: not an option.
    """

    count: int = 3
    ratio: float = 0.85
    share: float | None = None
    mode: Literal["slow", "fast"] = "slow"
    sizes: tuple[int, ...] = (480, 360)
    quick: bool = False
    folder: Path | None = None
    hidden: int = 0


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> click.Command:
    monkeypatch.setattr(_generated.importlib, "import_module", lambda *_: sys.modules[__name__])
    fields = FieldOptions(
        "here:Options", skip=("hidden",), flags={"sizes": "--size"}, defaults={"share": "as ratio"}
    )

    @generated_command(fields)
    @click.argument("name")
    @click.option("--json", "as_json", is_flag=True, help="JSON.")
    def run(name: str, as_json: bool, **values: Any) -> None:
        click.echo(repr((name, as_json, given_only(values))))

    return run


@pytest.mark.parametrize(
    ("arguments", "given"),
    [
        ("", {}),
        ("--count 7 --ratio .5", {"count": 7, "ratio": 0.5}),
        ("--mode fast --quick", {"mode": "fast", "quick": True}),
        ("--no-quick", {"quick": False}),
        ("--size 1 --size 2", {"sizes": (1, 2)}),
        ("--folder a/b", {"folder": Path("a/b")}),
    ],
)
def test_values_have_the_types_of_the_fields(
    command: click.Command, arguments: str, given: dict[str, Any]
) -> None:
    result = CliRunner().invoke(command, ["me", *arguments.split()])
    assert result.output.strip() == repr(("me", False, given))


def test_help_is_that_of_the_docstring(command: click.Command) -> None:
    text = " ".join(CliRunner().invoke(command, ["--help"], terminal_width=200).output.split())
    assert "--count INTEGER How many. [default: 3]" in text
    assert "second sentence" not in text
    assert "--share FLOAT Numbers on two lines. [default: as ratio]" in text
    assert "--mode [slow|fast] How. [default: slow]" in text
    assert "--size INTEGER Several sizes. [default: 480 360]" in text
    assert "--quick / --no-quick Whether it is quick. [default: no]" in text
    assert "--folder PATH Where; None: nowhere. --json" in text
    assert "hidden" not in text


@pytest.mark.parametrize("arguments", ["--count x", "--mode medium", "--cuont 1"])
def test_wrong_values_are_usage_errors(command: click.Command, arguments: str) -> None:
    assert CliRunner().invoke(command, ["me", *arguments.split()]).exit_code == 2


def test_the_list_of_commands_imports_no_heavy_package() -> None:
    code = (
        "import sys\nfrom deepdetect.cli import main\n"
        "try: main(['--help'])\nexcept SystemExit: pass\n"
        "print(sorted({'numpy', 'cv2', 'torch', 'onnxruntime'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
