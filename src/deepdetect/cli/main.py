"""The command `deepdetect`: its subcommands, and how errors are reported."""

from __future__ import annotations

import difflib
import sys
from typing import Any

import click

from .._shared.errors import BatchError, DeepDetectError, NoDepthError, RegistrationError
from .._shared.kernels import announce_compilation
from .._shared.progress import say
from ._generated import with_flags
from ._options import NOTHING_FOUND
from .app import app
from .average import average
from .benchmark import benchmark
from .datasets import datasets
from .demo import demo
from .detect import detect
from .doctor import doctor
from .evaluate import evaluate
from .evaluate_stereo import evaluate_stereo
from .export import export
from .extract import extract
from .label import label
from .match import match
from .match_many import match_many
from .reconstruct import reconstruct
from .register import register
from .shards import shards
from .stitch import stitch
from .track import track
from .train import train
from .train_points import train_points

OLD_FLAGS = {
    "--against": "--compare",
    "--calib": "--calibration",
    "--color-changes": "--color-jitter",
    "--dark-marked-weight": "--low-light-pos-weight",
    "--doubtful-only": "--pos-weight-uncertain",
    "--explain": "--visualize",
    "--in-turn": "--no-interleave",
    "--layers": "--freeze-encoder",
    "--loaders": "--num-workers",
    "--marked-weight": "--pos-weight",
    "--only": "--baselines",
    "--photos-a-shard": "--shard-size",
    "--start": "--init",
    "--validations": "--val-count",
    "--variations": "--augmentations",
}
"""What flags of older versions are called today."""


class Commands(click.Group):
    """A group that names the nearest right command, and ends with exit code 2 on user errors.

    With 1 where some of many files could not be worked on, with 3 where nothing was found.
    """

    def resolve_command(self, context: click.Context, args: list[str]) -> Any:
        name = args[0]
        if self.get_command(context, name) is None and not name.startswith("-"):
            nearest = difflib.get_close_matches(name, self.commands, n=1)
            hint = f" Did you mean '{nearest[0]}'?" if nearest else ""
            raise click.UsageError(f"There is no command '{name}'.{hint}", context)
        return super().resolve_command(context, args)

    def invoke(self, context: click.Context) -> Any:
        try:
            return super().invoke(context)
        except click.NoSuchOption as error:
            new = OLD_FLAGS.get(error.option_name)
            if error.ctx is None or not any(new in each.opts for each in error.ctx.command.params):
                raise
            raise click.UsageError(f"{error.message} Did you mean '{new}'?", error.ctx) from None
        except BatchError as error:
            command = self.get_command(context, context.invoked_subcommand or "")
            click.echo(f"deepdetect: {error.summary}:", err=True)
            for failure in error.failures:
                click.echo(f"  {with_flags(failure, command)}", err=True)
            context.exit(1)
        except DeepDetectError as error:
            command = self.get_command(context, context.invoked_subcommand or "")
            click.echo(f"deepdetect: {with_flags(str(error), command)}", err=True)
            nothing_found = isinstance(error, NoDepthError | RegistrationError)
            context.exit(NOTHING_FOUND if nothing_found else 2)
        except KeyboardInterrupt:
            click.echo("deepdetect: stopped; what was written stays", err=True)
            context.exit(130)
        except BrokenPipeError:
            sys.stderr.close()
            context.exit(1)


@click.group(
    cls=Commands,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(package_name="deepdetect", prog_name="deepdetect")
def main() -> None:
    """Dense keypoints from a tiny network, and their matches.

    \b
    deepdetect detect photo.jpg            keypoints of a photograph
    deepdetect match left.jpg right.jpg    matches between two photographs
    deepdetect reconstruct left.jpg right.jpg --focal 1250    a 3D reconstruction

    Each command has its own --help.
    """
    announce_compilation(
        lambda: say("compiling for the first time, about 10 seconds; it is kept for later runs")
    )


for command in (
    detect,
    match,
    register,
    stitch,
    reconstruct,
    extract,
    match_many,
    track,
    label,
    shards,
    train,
    train_points,
    average,
    export,
    datasets,
    evaluate,
    evaluate_stereo,
    benchmark,
    demo,
    doctor,
    app,
):
    main.add_command(command)
