"""Options of commands, made from the library's signatures, and ways to print results."""

from __future__ import annotations

import inspect
import json
import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from cyclopts import Group, Parameter
from cyclopts.validators import Number

from .._shared.atomic import atomic_path
from .._shared.errors import BatchError, DeepDetectError, OptionError
from .._shared.records import Outputs, check_not_made, outputs_in
from .._shared.signals import handle_signals

NOTHING_FOUND = 3
"""Exit code where all went well and nothing was found."""

MORE = Group("More options")
"""Shown by --help-all."""

ALIASES = {"max_keypoints": ("--num-keypoints", "--top-k", "--max-num-keypoints")}
"""What people type."""

Function = TypeVar("Function", bound=Callable[..., Any])


@dataclass(frozen=True)
class From:
    """Parameters of a function or class that are options of a command.

    Name, type, default and help of an option are those of the parameter and of its docstring.

    Attributes:
        target: the function or class.
        names: of the parameters, with blanks between; empty for all.
        common: those that --help shows; the others are shown by --help-all.
        flags: flags that are not the name, as {"focal_px": "--focal"}, or with the negative one
            after a slash.
        types: types of parameters that are wider than what can be typed.
        defaults: what the help says of the default, where the value does not say it.
    """

    target: Callable[..., Any]
    names: str = ""
    common: str = ""
    flags: Mapping[str, str] = field(default_factory=dict)
    types: Mapping[str, Any] = field(default_factory=dict)
    defaults: Mapping[str, str] = field(default_factory=dict)

    def parameters(self) -> Iterator[inspect.Parameter]:
        """Make the options as keyword parameters."""
        parameters = inspect.signature(self.target).parameters
        helps = attribute_helps(inspect.getdoc(self.target) or "")
        scope = vars(sys.modules[self.target.__module__])
        for name in self.names.split() or parameters:
            hint = self.types.get(name) or eval(str(parameters[name].annotation), scope)
            flag, _, negative = self.flags.get(name, "").partition("/")
            settings: dict[str, Any] = {"name": flag or None, "alias": ALIASES.get(name)}
            settings |= {"negative": negative.split()} if negative else {}
            if name in self.defaults:
                settings["show_default"] = lambda _, text=self.defaults[name]: text
            settings |= {} if name in self.common.split() else {"group": MORE}
            annotation: Any = Annotated[hint, Parameter(help=helps.get(name), **settings)]
            yield parameters[name].replace(
                kind=inspect.Parameter.KEYWORD_ONLY, annotation=annotation
            )

    def take(self, values: dict[str, Any]) -> dict[str, Any]:
        """Take these options out of those that were given."""
        names = self.names.split() or inspect.signature(self.target).parameters
        return {name: values.pop(name) for name in names if name in values}


def with_options(*sources: From) -> Callable[[Function], Function]:
    """Give a command with `**values` the options of other functions: those that are given."""

    def decorate(function: Function) -> Function:
        own = [*inspect.signature(function).parameters.values()][:-1]
        made = [option for source in sources for option in source.parameters()]
        function.__signature__ = inspect.Signature([*own, *made])  # type: ignore[attr-defined]
        return function

    return decorate


def attribute_helps(doc: str) -> dict[str, str]:
    """Return the first sentence on each attribute or argument of a Google style docstring.

    Example:
        >>> helps = attribute_helps('''Options.
        ...
        ... Attributes:
        ...     ratio, mutual: of the ratio test, which
        ...         is Lowe's. More text.
        ... ''')
        >>> helps["mutual"]
        "Of the ratio test, which is Lowe's."
    """
    match = re.search(r"^(?:Attributes|Args):\n((?:[ \t]+.*\n?|\n)*)", doc, flags=re.MULTILINE)
    section = textwrap.dedent(match.group(1)) if match else ""
    helps: dict[str, str] = {}
    for entry in re.split(r"\n(?=\S)", section.strip()):
        names, _, text = " ".join(entry.split()).partition(": ")
        sentence = re.split(r"(?<=[.)])\s(?=[A-Z])", text)[0]
        helps |= {name.strip(): sentence[:1].upper() + sentence[1:] for name in names.split(",")}
    return helps


Images = Annotated[list[Path], Parameter(help="Image files or folders.")]
Image = Annotated[Path, Parameter(help="Image file.")]
Output = Annotated[Path, Parameter(name=("--output", "-o"))]
Folder = Annotated[Path, Parameter(name=("--output", "-o"), help="Folder for the results.")]
Overwrite = Annotated[
    bool, Parameter(negative="", help="Replace what exists already, and do all of it again.")
]
Json = Annotated[bool, Parameter("--json", negative="", help="Print the result as JSON.")]
Format = Annotated[Literal["npz", "csv"], Parameter("--format", help="Format of the data files.")]
MaxMegapixels = Annotated[
    float, Parameter(group=MORE, help="Refuse larger images before they are decoded.")
]
Workers = Annotated[
    int | None,
    Parameter(
        group=MORE,
        validator=Number(gte=1),
        help="Processes at work.  [default: one per processor of the machine or cluster]",
    ),
]
Engine = Annotated[
    str,
    Parameter(
        group=MORE,
        help="What does the work: processes of this machine, or ray for a cluster (RAY_ADDRESS).",
    ),
]


def output_file(output: Path, name: str) -> Path:
    """Return the file that -o names: itself where it has an ending, else one of a folder."""
    return output if output.suffix and not output.is_dir() else output / name


def output_folder(output: Path) -> Path:
    """Return the folder that -o names.

    Raises:
        OptionError: it has the ending of a file.
    """
    if re.fullmatch(r"\.(npz|csv|json|txt|png|jpe?g|tiff?|webp)", output.suffix.lower()):
        raise OptionError(f"-o names the folder for all results: {output} looks like one file")
    return output


def expand_images(paths: Sequence[Path], output: Path) -> list[Path]:
    """Replace folders by the images below them, and check that results will not collide.

    The folder of the results is left out when it lies in one of the folders; where it is one of
    them, what earlier runs made in it.

    Raises:
        ImageError: a folder holds no image.
        OptionError: two images have one name, or a folder holds only what earlier runs made.
    """
    from ..io.image import find_images

    images: dict[Path, None] = {}
    for path in paths:
        below = find_images(path, [output]) if path.is_dir() else [path]
        if path.is_dir() and path.resolve() == output.resolve():
            made = outputs_in(output)
            below = [each for each in below if not (each.parent == path and each.name in made)]
            if not below:
                raise OptionError(f"all images in {path} are results of earlier runs")
        images |= dict.fromkeys(below)
    seen: dict[str, Path] = {}
    for image in images:
        if image.stem in seen:
            raise OptionError(
                f"{seen[image.stem]} and {image} would write the same files: "
                "rename one, or do them one after the other into two folders"
            )
        seen[image.stem] = image
    return list(images)


def check_inputs_survive(outputs: Iterable[Path], inputs: Iterable[Path]) -> None:
    """Check that no file to be written is one of those that are read, under whatever name.

    Raises:
        OptionError: one is.
    """
    # Not by name: links, and capitals on some systems, give one file several.
    existing = [path for path in inputs if path.exists()]
    for output in outputs:
        if output.exists() and any(output.samefile(path) for path in existing):
            raise OptionError(
                f"{output} would be written over, which is an input: choose another place with -o"
            )


def check_folder_not_made(folder: Path, output: Path) -> None:
    """Refuse a folder that holds images which earlier runs made, but for those below the output.

    Raises:
        OptionError: one of them is an output, or lies in a folder that is one.
    """
    from ..io.image import find_images

    if any(folder.glob("**/.deepdetect")):
        check_not_made(folder, find_images(folder, [output]))


@contextmanager
def whole(files: Mapping[str, Path]) -> Iterator[dict[str, Path]]:
    """Give temporary paths for files; all of them appear when the block succeeds, else none."""
    with ExitStack() as stack:
        yield {name: stack.enter_context(atomic_path(path)) for name, path in files.items()}


@contextmanager
def writing(outputs: Outputs) -> Iterator[dict[str, Any]]:
    """Write outputs, as `Outputs.writing`; signals that end the process leave no trace either."""

    def end(number: int, _: object) -> None:
        raise SystemExit(128 + number)  # as a shell has it

    with handle_signals(end), outputs.writing() as values:
        yield values


def report_failures(failures: Sequence[str], total: int, what: str = "images") -> None:
    """Raise a BatchError when some of several images failed; of a single one, its error."""
    if failures and total == 1:
        raise DeepDetectError(failures[0])
    if failures:
        raise BatchError(f"{len(failures)} of {total} {what} failed, the others are done", failures)


def note(text: str) -> None:
    """Print a line to standard error."""
    print(text, file=sys.stderr)


def print_json(value: Any) -> None:
    """Print a value as JSON; paths become text."""
    print(json.dumps(value, indent=2, default=str))


def print_result(as_json: bool, values: Mapping[str, Any], title: str = "") -> None:
    """Print the result of a command: as JSON, or as a table of its names and values."""
    if as_json:
        print_json(values)
    else:
        print_table(_rows(values), title)


def print_columns(values: Sequence[Mapping[str, Any]]) -> None:
    """Print several results of the same kind side by side."""
    columns = [dict(_rows(each)) for each in values]
    names = dict.fromkeys(name for column in columns for name in column)
    wide = max(len(name) for name in names)
    for name in names:
        print(f"  {name:<{wide}}", *(f"{column.get(name, '-'):>20}" for column in columns))


MAX_DEPTH = 2
"""Of dictionaries within others, in a table."""


def _rows(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield the rows of a table; tables and matrices within are left to JSON."""
    for name, value in values.items():
        if name == "failures":  # listed at the end
            continue
        title = prefix + str(name).replace("_", " ")
        if isinstance(value, Mapping):
            yield from () if prefix.count(":") == MAX_DEPTH else _rows(value, f"{title}: ")
        elif isinstance(value, (list, tuple)):
            if value and not any(isinstance(each, (list, tuple, Mapping)) for each in value):
                yield title, ", ".join(map(_text, value))
        elif value is not None:
            yield title, _text(value)


def _text(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def print_table(rows: Iterable[tuple[str, str]], title: str = "") -> None:
    """Print names and values in two columns."""
    if title:
        print(title)
    rows = list(rows)
    width = max((len(name) for name, _ in rows), default=0)
    for name, value in rows:
        print(f"  {name:<{width}}  {value}")
