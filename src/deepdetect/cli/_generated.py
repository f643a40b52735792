"""Options of commands, generated from the dataclasses and functions of the library.

Name, type, default and help of an option are those of the parameter and its docstring, so that the
command line says what the library does. They are imported when the command is run or its help is
shown: `deepdetect --help` stays fast.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import re
import sys
import textwrap
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import click

Function = Callable[..., Any]


@dataclasses.dataclass(frozen=True)
class FieldOptions:
    """The fields of a dataclass, or parameters of a function, that are options of a command.

    Attributes:
        path: module and name, as "features.selection:SelectionOptions", within the package.
        names: the parameters, in the order of the help; empty for all.
        skip: parameters that are left out.
        flags: flags that are not the name, as {"short_sides": "--short-side"}, or
            {"guided": "--guided/--unguided"}.
        metavars: what stands for the value in the help, where it is not the type.
        types: click's types of parameters whose annotation does not say it.
        defaults: what is used unless the option is given, where it is not the parameter's default;
            for the help.
    """

    path: str
    names: Sequence[str] = ()
    skip: Sequence[str] = ()
    flags: Mapping[str, str] = dataclasses.field(default_factory=dict)
    metavars: Mapping[str, str] = dataclasses.field(default_factory=dict)
    types: Mapping[str, click.ParamType[Any]] = dataclasses.field(default_factory=dict)
    defaults: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def make(self) -> list[click.Option]:
        """Import the class or function and make the options."""
        module, name = self.path.split(":")
        target = getattr(importlib.import_module(f"..{module}", __package__), name)
        parameters = inspect.signature(target).parameters
        helps = attribute_helps(inspect.getdoc(target) or "")
        scope = vars(sys.modules[target.__module__])
        chosen = self.names or [name for name in parameters if name not in self.skip]
        # Only what is chosen is evaluated: other annotations may be there for type checkers only.
        hints = {name: eval(parameters[name].annotation, scope) for name in chosen}
        return [self._option(parameters[name], hints[name], helps[name]) for name in chosen]

    def _option(self, parameter: inspect.Parameter, hint: Any, text: str) -> click.Option:
        name = parameter.name
        flag = self.flags.get(name, "--" + name.replace("_", "-"))
        settings = _type_settings(hint) | {"help": text, "metavar": self.metavars.get(name)}
        if name in self.types:
            settings["type"] = self.types[name]
        if settings.pop("switch", False) and "/" not in flag:
            flag = f"{flag}/--no-{flag.removeprefix('--')}"
        if shown := self.defaults.get(name, _default_text(parameter.default)):
            settings["help"] += f"  [default: {shown}]"
        return click.Option([flag, name], **settings)


class GeneratedCommand(click.Command):
    """A command some of whose options are made when they are first needed."""

    generated: Sequence[FieldOptions] = ()

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Return the options, the generated ones before the others."""
        if self.generated:
            made = [option for fields in self.generated for option in fields.make()]
            arguments = [one for one in self.params if isinstance(one, click.Argument)]
            others = [one for one in self.params if not isinstance(one, click.Argument)]
            self.params, self.generated = [*arguments, *made, *others], ()
        return super().get_params(ctx)


def generated_command(
    *fields: FieldOptions, **settings: Any
) -> Callable[[Function], GeneratedCommand]:
    """Make a command with generated options.

    An option that is not given is None (or, where it may be repeated, an empty tuple): `given_only`
    leaves these out.
    """

    def decorate(function: Function) -> GeneratedCommand:
        command = click.command(cls=GeneratedCommand, **settings)(function)
        command.generated = fields
        return command

    return decorate


def given_only(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of the options that were given.

    Example:
        >>> given_only({"threshold": None, "density": 0.1, "short_sides": ()})
        {'density': 0.1}
    """
    return {name: value for name, value in values.items() if value is not None and value != ()}


def with_flags(message: str, command: click.Command | None) -> str:
    """Name a command's options where a message of the library names parameters.

    These are words with an underscore, or words between backticks, alone or with a value.

    Example:
        >>> names = "--rectified/--not-rectified", "--nms-radius"
        >>> options = [click.Option([name]) for name in names]
        >>> with_flags("set nms_radius, or `rectified=False`", click.Command("x", params=options))
        'set --nms-radius, or --not-rectified'
    """
    options = {option.name: option for option in command.params} if command else {}

    def flag(match: re.Match[str]) -> str:
        option = options.get(match[1] or match[3])
        value = match[2]
        if not isinstance(option, click.Option):
            return match[0].strip("`")
        if option.is_flag:
            return (option.secondary_opts if value == "False" else option.opts)[-1]
        return option.opts[-1] if value is None else f"{option.opts[-1]} {value.strip(chr(34))}"

    quoted = r"`(\w+)(?:=([^`]+))?`"
    bare = r"(?<![\w./\\\"'-])([a-z0-9]+(?:_[a-z0-9]+)+)(?![\w./\\\"'-])"
    return re.sub(f"{quoted}|{bare}", flag, message)


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


def _type_settings(hint: Any) -> dict[str, Any]:
    """Return click's settings for an annotation."""
    parts = [part for part in typing.get_args(hint) if part is not type(None)]
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        repeated = any(typing.get_origin(part) is Sequence for part in parts)
        return _type_settings(parts[0]) if len(parts) == 1 else {"type": str, "multiple": repeated}
    if typing.get_origin(hint) is Literal:
        return {"type": click.Choice([str(value) for value in typing.get_args(hint)])}
    if typing.get_origin(hint) is tuple and len(parts) == 2 and parts[1] is Ellipsis:
        return _type_settings(parts[0]) | {"multiple": True}
    if hint is bool:
        return {"switch": True, "default": None}
    if hint is Path:
        return {"type": click.Path(path_type=Path)}
    return {"type": hint if hint in (int, float, str) else str}


def _default_text(value: Any) -> str:
    """Return a default for the help; none where it is None, which the text explains."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple):
        return " ".join(map(str, value))
    if isinstance(value, float):
        return f"{value:g}"
    return str(value) if isinstance(value, (int, str)) else ""
