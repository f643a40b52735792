"""`deepdetect completion`: completion of commands and options by Tab."""

from __future__ import annotations

from typing import Annotated, Literal

from cyclopts import Parameter

from ._app import make_app

Shell = Annotated[
    Literal["bash", "zsh", "fish", "powershell"], Parameter(help="Name of the shell.")
]


def completion(shell: Shell, /) -> None:
    """Print what makes a shell complete commands, options and choices.

    deepdetect completion bash > ~/.local/share/bash-completion/completions/deepdetect
    deepdetect completion zsh > ~/.zsh/completions/_deepdetect
    deepdetect completion fish > ~/.config/fish/completions/deepdetect.fish
    """
    print(make_app().generate_completion(shell=shell))
