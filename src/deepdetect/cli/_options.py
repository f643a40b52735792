"""Command options that are generated from the library's signatures, and printing of results."""

from __future__ import annotations

import functools
import inspect
import json
import re
import sys
import textwrap
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from cyclopts import Parameter

from .._shared.atomic import atomic_path
from .._shared.errors import BatchError, DeepDetectError, OptionError
from .._shared.progress import say as say
from .._shared.records import Outputs, inputs_of
from .._shared.signals import exit_by_signal, handle_signals
from ..io.image import load_image, name_images
from ..io.image_file import MAX_MEGAPIXELS, read_with, reading_options
from ._app import MORE
from ._app import NOTHING_FOUND as NOTHING_FOUND

CELL_WIDTH = 18
"""Minimum width of a cell of a printed table, in characters. Chosen by hand."""

TEXT_WIDTH = 100
"""Maximum length of a line of a wrapped table, in characters; longer words exceed it."""


@dataclass(frozen=True)
class From:
    """Parameters of a function or class that become options of a command.

    An option has the name, the type and the default of the parameter. Its help is the docstring's
    first sentence about the parameter.

    Attributes:
        target: the function or class.
        common: names of the options that --help shows, separated by blanks.
        more: names of the options that only --help-all shows. None: all other parameters.
        flags: flags of options that are not named like their parameter, such as
            {"focal_px": "--focal"}. "--on/--off" are the two flags of a boolean.
        types: types of options whose parameters accept values that cannot be typed in a shell.
        defaults: texts that the help shows in place of the default value.
    """

    target: Callable[..., Any]
    common: str = ""
    more: str | None = None
    flags: Mapping[str, str] = field(default_factory=dict)
    types: Mapping[str, Any] = field(default_factory=dict)
    defaults: Mapping[str, str] = field(default_factory=dict)

    def names(self) -> dict[str, None]:
        """Return the names of the parameters."""
        more = inspect.signature(self.target).parameters if self.more is None else self.more.split()
        return dict.fromkeys([*self.common.split(), *more])

    def parameters(self) -> Iterator[inspect.Parameter]:
        """Yield the options as keyword parameters."""
        parameters = inspect.signature(self.target).parameters
        helps = attribute_helps(inspect.getdoc(self.target) or "")
        scope = vars(sys.modules[self.target.__module__])
        for name in self.names():
            hint = self.types.get(name) or eval(str(parameters[name].annotation), scope)
            flag, _, negative = self.flags.get(name, "").partition("/")
            settings: dict[str, Any] = {"name": flag or None}
            settings |= {"negative": negative.split()} if negative else {}
            if name in self.defaults:
                settings["show_default"] = lambda _, text=self.defaults[name]: text
            settings |= {} if name in self.common.split() else {"group": MORE}
            annotation: Any = Annotated[hint, Parameter(help=helps.get(name), **settings)]
            yield parameters[name].replace(
                kind=inspect.Parameter.KEYWORD_ONLY, annotation=annotation
            )

    def take(self, values: dict[str, Any]) -> dict[str, Any]:
        """Move the options that this object names out of `values`, and return them."""
        return {name: values.pop(name) for name in self.names() if name in values}


READING = From(
    load_image,
    more="max_megapixels value_range bands page allow_truncated",
    types={"allow_truncated": bool},
    defaults={"max_megapixels": f"{MAX_MEGAPIXELS:g}"},
)

T = TypeVar("T")
More = Annotated[T, Parameter(group=MORE)]

Json = Annotated[bool, Parameter("--json", negative="", help="Print the result as JSON.")]
JSON = inspect.Parameter("as_json", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=Json)


@dataclass(frozen=True)
class Result:
    """The result of a command, which is printed when it returns.

    Attributes:
        values: what --json prints. If there is no text, the terminal shows `values` as a table.
        text: output for the terminal: the most important facts, at most a dozen lines.
        failures: a sentence about each input that failed. If there are any, the exit code is 1.
        total, what: number of inputs (0 if unknown), and a plural noun for them. If the only input
            fails, its failure is raised as the error.
        exit_code: exit code if nothing failed.
    """

    values: Any
    text: str | None = None
    failures: Sequence[str] = ()
    total: int = 0
    what: str = "images"
    exit_code: int = 0

    def show(self, as_json: bool) -> int:
        """Print the result; return the exit code, or raise the failures as an error."""
        if as_json:
            print(json.dumps(self.values, indent=2, default=str))
        elif text := table(self.values) if self.text is None else self.text:
            print(text)
        if self.failures and self.total == 1:
            raise DeepDetectError(self.failures[0])
        if self.failures:
            number = f"{len(self.failures)} of {self.total or 'the'} {self.what}"
            raise BatchError(f"{number} failed; the others are done", self.failures)
        return self.exit_code


def command(
    *sources: From, prints: bool = True
) -> Callable[[Callable[..., Result | None]], Callable[..., int]]:
    """Turn a function into a command, which prints its result and has the option --json.

    Parameters in `sources` become options; those set are passed as `**values`.
    """

    def decorate(function: Callable[..., Result | None]) -> Callable[..., int]:
        @functools.wraps(function)
        def run(*arguments: Any, as_json: bool = False, **values: Any) -> int:
            reading = READING.take(values) if READING in sources else {}
            with read_with(reading_options(**reading)):
                result = function(*arguments, **values)
            return 0 if result is None else result.show(as_json)

        signature = inspect.signature(function, eval_str=True)
        own = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
        made = [option for source in sources for option in source.parameters()]
        options = [*own, *([JSON] if prints else []), *made]
        run.__signature__ = signature.replace(parameters=options)  # type: ignore[attr-defined]
        return run

    return decorate


def attribute_helps(doc: str) -> dict[str, str]:
    """Return the first sentence about each attribute or argument of a Google style docstring.

    Example:
        >>> helps = attribute_helps('''Options.
        ...
        ... Attributes:
        ...     ratio, mutual: settings of the
        ...         ratio test. More text.
        ... ''')
        >>> helps["mutual"]
        'Settings of the ratio test.'
    """
    match = re.search(r"^(?:Attributes|Args):\n((?:[ \t]+.*\n?|\n)*)", doc, flags=re.MULTILINE)
    section = textwrap.dedent(match.group(1)) if match else ""
    helps: dict[str, str] = {}
    for entry in re.split(r"\n(?=\S)", section.strip()):
        names, _, text = " ".join(entry.split()).partition(": ")
        sentence = re.split(r"(?<=[.)])\s(?=[A-Z])", text)[0]
        helps |= {name.strip(): sentence[:1].upper() + sentence[1:] for name in names.split(",")}
    return helps


Images = Annotated[Path, Parameter(help="Image files or folders.", required=True)]
Image = Annotated[Path, Parameter(help="Image file.")]
Output = Annotated[Path, Parameter(name=("--output", "-o"))]
Folder = Annotated[Path, Parameter(name=("--output", "-o"), help="Folder for the results.")]
Overwrite = Annotated[
    bool, Parameter(negative="", help="Replace existing files, and repeat all work.")
]
Format = Annotated[Literal["npz", "csv"], Parameter("--format", help="Format of the data files.")]


def output_file(output: Path, name: str) -> Path:
    """Return the output file: -o itself if it has a suffix, otherwise `name` in the folder -o."""
    return output if output.suffix and not output.is_dir() else output / name


def output_files(output: Path, stem: str, endings: Mapping[str, str]) -> dict[str, Path]:
    """Return the output file of each kind: `stem` plus the ending of the kind, in the folder -o.

    If there is only one kind, -o may also be the .npz or .csv file itself.
    """
    if len(endings) == 1 and output.suffix in (".npz", ".csv"):
        return dict.fromkeys(endings, output)
    return {kind: output_folder(output) / f"{stem}{ending}" for kind, ending in endings.items()}


def output_folder(output: Path) -> Path:
    """Return the folder that -o names; raise an OptionError if it looks like a file."""
    if re.fullmatch(r"\.(npz|csv|json|txt|png|jpe?g|tiff?|webp)", output.suffix.lower()):
        raise OptionError(f"{output} looks like a file: give a folder for all results with -o")
    return output


def expand_images(paths: Sequence[Path], output: Path) -> dict[str, Path]:
    """Return the given images and those below the given folders, named as by `name_images`.

    Left out: images in the output folder and, with a message, files made from other given images.
    """
    given = {str(path.resolve()) for path in paths}
    kept = []
    for path in paths:
        if given & {*inputs_of(path)}:  # as with *.jpg, which also matches results
            say(f"{path} is a result from other given images, and is left out")
        else:
            kept.append(path)
    return name_images(kept, [output])


def result_stems(images: Mapping[str, Path]) -> dict[Path, str]:
    """Return the stem of each image's result files: its name, without suffix if that is unique."""
    stems = {name: name.removesuffix(path.suffix) for name, path in images.items()}
    count = Counter(stems.values())
    return {path: stems[n] if count[stems[n]] == 1 else n for n, path in images.items()}


def check_outputs(outputs: Iterable[Path], inputs: Iterable[Path]) -> None:
    """Raise an OptionError if a file would be written twice, or would replace an input."""
    # Comparing names does not suffice, because of links and of systems that ignore case.
    files = {(path.stat().st_dev, path.stat().st_ino) for path in inputs if path.exists()}
    seen: set[Path] = set()
    for output in outputs:
        if output.exists() and (output.stat().st_dev, output.stat().st_ino) in files:
            raise OptionError(f"{output} would replace an input: choose another place with -o")
        if output in seen:
            raise OptionError(
                f"two images would both write {output}: rename one, or use two folders"
            )
        seen.add(output)


@contextmanager
def claimed(outputs: Outputs) -> Iterator[dict[str, Any]]:
    """Write outputs as `Outputs.writing` does, and clean up even if a signal ends the process."""
    with handle_signals(exit_by_signal), outputs.writing() as values:
        yield values


@contextmanager
def whole(files: Mapping[Any, Path]) -> Iterator[dict[Any, Path]]:
    """Yield temporary paths, which get their final names only if the whole block succeeds."""
    with ExitStack() as stack:
        yield {name: stack.enter_context(atomic_path(path)) for name, path in files.items()}


@contextmanager
def writing(
    files: Mapping[Any, Path], inputs: Sequence[Path], overwrite: bool
) -> Iterator[dict[Any, Path]]:
    """Yield temporary paths for files, as `whole` does, and record the inputs.

    Raise an OptionError if a file would replace an input or, without `overwrite`, the result of
    other inputs.
    """
    check_outputs(files.values(), inputs)
    with claimed(Outputs([*files.values()], inputs, overwrite=overwrite)), whole(files) as made:
        yield made


def headed(sentence: str, values: Mapping[str, Any], names: str) -> str:
    """Return a sentence and a table of the named values; the times in "seconds" are summed."""
    shown = {name: values.get(name) for name in names.split()}
    if isinstance(seconds := shown.get("seconds"), Mapping):
        shown["seconds"] = sum(seconds.values())
    return table(shown, title=sentence, wrapped=True)


def table(*columns: Mapping[str, Any], title: str = "", wrapped: bool = False) -> str:
    """Return a text table: each row has a name and its value in each of the columns.

    Lists of lists or of mappings are left out. Long values are wrapped only if `wrapped`.
    """
    texts = [dict(_table_rows(values)) for values in columns]
    names = dict.fromkeys(name for column in texts for name in column)
    width = max(map(len, names), default=0)
    indent = max(CELL_WIDTH, width + 2) + 2
    rows = [[f"  {name:<{width}}", *(column.get(name, "-") for column in texts)] for name in names]
    if wrapped:
        rows = [[name, _wrapped(text, indent)] for name, text in rows]
    lines = ["  ".join(f"{text:<{CELL_WIDTH}}" for text in row).rstrip() for row in rows]
    return "\n".join([title, *lines] if title else lines)


def _wrapped(text: str, indent: int) -> str:
    lines = textwrap.wrap(text, TEXT_WIDTH - indent, break_long_words=False, break_on_hyphens=False)
    return ("\n" + indent * " ").join(lines)


def _table_rows(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for name, value in values.items():
        if name == "failures":  # `Result.show` lists them at the end
            continue
        title = prefix + str(name).replace("_", " ")
        if isinstance(value, Mapping):
            yield from _table_rows(value, f"{title}: ")
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
