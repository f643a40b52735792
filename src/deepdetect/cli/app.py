"""`deepdetect app`: the page in a browser, on this computer."""

from __future__ import annotations

from typing import Any

import click

from .._shared.errors import MissingExtraError, install_command
from ._generated import FieldOptions, generated_command, given_only

LIMITS = FieldOptions("app.options:AppOptions")


@generated_command(LIMITS, short_help="A page in the browser, on this computer.")
@click.option("--open", "open_browser", is_flag=True, help="Open the page in the browser.")
def app(open_browser: bool, **values: Any) -> None:
    """Serve a page at 127.0.0.1: keypoints, matches, registration, panoramas and 3D models.

    It prints the address to open, which ends in a key that is new at each start. Images stay
    on this computer, and are removed after each task. Ctrl+C ends it.

    \b
    deepdetect app
    deepdetect app --port 0 --open
    """
    import webbrowser

    from ..app.options import AppOptions

    try:
        from ..app.server import AppServer
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            f"deepdetect app needs {error.name}: {install_command('starlette', 'uvicorn')}"
        ) from None

    with AppServer(AppOptions(**given_only(values))) as server:
        try:
            click.echo(f"DeepDetect is at {server.address}")
            click.echo("Ctrl+C ends it.", err=True)
            if open_browser:
                webbrowser.open(server.address)
            server.serve_forever()
        except KeyboardInterrupt:
            click.echo("deepdetect: ended; nothing was kept", err=True)
