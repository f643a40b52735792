"""`deepdetect app`: a page in the browser that runs on this computer."""

from __future__ import annotations

import webbrowser
from typing import Annotated, Any

from cyclopts import Parameter

from .._shared.errors import require_packages
from .._shared.progress import say
from .._shared.signals import endings_interrupt
from ..app.jobs import AppOptions
from ._options import From, command


@command(From(AppOptions, "port"), prints=False)
def app(
    *, open_browser: Annotated[bool, Parameter("--open", negative="")] = False, **values: Any
) -> None:
    """Serve a page at 127.0.0.1 for keypoints, matches, registration, panoramas and 3D models.

    Prints the address to open, which ends in a key that is new at each start. Images stay on this
    computer and are deleted after each task. Ctrl+C ends the server.

        deepdetect app
        deepdetect app --port 0 --open

    Args:
        open_browser: Open the page in the browser.
    """
    require_packages("deepdetect app", "starlette", "uvicorn")
    from ..app.server import AppServer

    # Any signal to end acts as Ctrl+C, so that tasks are stopped and their files are deleted.
    with endings_interrupt(), AppServer(AppOptions(**values)) as server:
        try:
            print(f"DeepDetect is at {server.address}", flush=True)
            say("Ctrl+C ends it.")
            if open_browser:
                webbrowser.open(server.address)
            server.serve_forever()
        except KeyboardInterrupt:
            say("deepdetect: ended; nothing was kept")
