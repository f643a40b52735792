from __future__ import annotations

import re
import subprocess
import sys

import pytest
from tests.command_line import run_command

from deepdetect.cli._app import COMMANDS, _all_commands, make_app, with_flags
from deepdetect_lab.cli import COMMANDS as LAB_COMMANDS
from deepdetect_lab.cli import DEVELOPMENT

PARTS = {"export": ("colmap", "hloc", "onnx"), "datasets": ("list", "get")}
WORDS = [
    [*before, name, *([part] if part else [])]
    for before, groups in (([], COMMANDS | LAB_COMMANDS), (["dev"], DEVELOPMENT))
    for group in groups.values()
    for name in group
    for part in PARTS.get(name, ("",))
]


@pytest.mark.parametrize(
    ("before", "groups"), [([], COMMANDS | LAB_COMMANDS), (["dev"], DEVELOPMENT)]
)
def test_help_names_every_command(before: list[str], groups: dict) -> None:
    text = run_command([*before, "--help"]).stdout
    for name in (name for group in groups.values() for name in group):
        assert re.search(rf"^. {name} ", text, re.M)


@pytest.mark.parametrize("words", WORDS, ids=" ".join)
def test_every_option_says_what_it_is(words: list[str]) -> None:
    result = run_command([*words, "--help-all"])
    assert result.exit_code == 0
    assert f"Usage: deepdetect {' '.join(words)}" in result.stdout
    app = make_app()
    for word in words:
        app = app[word]
    for argument in app.assemble_argument_collection(parse_docstring=True):
        assert argument.parameter.help, argument.name
        if argument.field_info.is_keyword:
            assert argument.name in result.stdout


@pytest.mark.parametrize(
    "words", [["train", "a"], ["dev", "average"], ["dev"], ["label", "--help"]]
)
def test_without_the_laboratory_one_sentence_says_what_to_install(
    words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: ())
    _all_commands.cache_clear()
    make_app.cache_clear()
    result = run_command(words)
    assert result.exit_code == 2
    assert len(result.stderr.splitlines()) == 1
    assert "pip install ./lab" in result.stderr
    assert "train" not in run_command(["--help"]).stdout
    _all_commands.cache_clear()
    make_app.cache_clear()


def test_common_options_come_first_and_the_others_on_request() -> None:
    short, long = (run_command(["match", flag]).stdout for flag in ("--help", "--help-all"))
    assert "--max-keypoints" in short
    assert "--iterations" not in short
    assert "more options: --help-all" in short
    assert "--iterations" in long
    assert run_command(["match", "--help"]).stdout == short


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("give `focal_px` or `calibration`", "give --focal or --calibration"),
        ("give `rectified=False`", "give --not-rectified"),
        ("give `rectified=True`", "give --rectified"),
        ('use `backend="openvino"`', "use --backend openvino"),
        ("use `no_such_option`, `LEFT`", "use no_such_option, LEFT"),
        ("focal_px must be above 0", "--focal must be above 0"),
        ('there is no "focal_px" in my_focal_px.json, focal_px.json', None),
    ],
)
def test_errors_name_flags_instead_of_parameters(message: str, expected: str | None) -> None:
    assert with_flags(message, ["reconstruct", "a", "b"]) == (expected or message)


@pytest.mark.parametrize(
    ("arguments", "right"),
    [
        ("dev benchmark oxford --data x --baselnes sift", "--baselines"),
        ("dev evaluate samples --comparee other.onnx", "--compare"),
        ("detect photo.jpg --max-keypiont 3", "--max-keypoints"),
        ("detect photo.jpg --detector point", "points"),
        ("detec photo.jpg", "detect"),
        ("export colmp photos", "colmap"),
        ("register x.png", "IMAGE1"),
        ("detect x.png --threshold high", "high"),
    ],
)
def test_what_is_wrong_names_the_right_word(arguments: str, right: str) -> None:
    result = run_command(arguments.split())
    assert result.exit_code == 2
    assert right in result.stderr


@pytest.mark.parametrize(
    "words",
    [
        "detect a --json b",
        "stitch a -o p.jpg b",
        "dev average a --output out b",
        "dev evaluate-stereo a --weights dense b",
        "export hloc a --overwrite b",
    ],
)
def test_options_may_stand_between_paths(words: str) -> None:
    _, bound, _ = make_app().parse_args(words.split(), print_error=False, exit_on_error=False)
    assert [str(path) for path in bound.args] == ["a", "b"]


def test_completion_knows_commands_options_and_choices() -> None:
    for shell in ("bash", "zsh", "fish"):
        script = run_command(["completion", shell]).stdout
        for word in ("train-points", "max-keypoints", "spherical", "patchmatch"):
            assert word in script


def test_the_help_is_fast() -> None:
    code = (
        "import sys; from deepdetect.cli import main; main(['--help']); print(sorted(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = done.stdout.splitlines()[-1]
    for name in ("numpy", "cv2", "onnxruntime", "openvino", "torch", "PIL"):
        assert f"'{name}'" not in loaded
