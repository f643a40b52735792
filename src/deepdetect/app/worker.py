"""What the process of one task does: the task, files in a folder, and messages to the server."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Mapping, Sequence
from multiprocessing import parent_process
from multiprocessing.connection import Connection
from pathlib import Path

from .._shared.errors import DeepDetectError
from .tasks import TASKS, SentImage


def main(
    sender: Connection,
    folder: Path,
    kind: str,
    images: Sequence[SentImage],
    options: Mapping[str, float],
    max_megapixels: float,
) -> None:
    """Do a task: its files are in `results` of the folder, its state is sent.

    The process ends with the server, with all that it has started.
    """
    from ..io.image_file import limit_megapixels

    if hasattr(os, "setsid"):
        os.setsid()  # so that all it starts can be ended
    for stream in (1, 2):  # what libraries print
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    threading.Thread(target=_end_with_the_server, daemon=True).start()
    (folder / "results").mkdir()

    def report(stage: str, done: int, total: int) -> None:
        sender.send({"state": "running", "stage": stage, "done": done, "total": total})

    try:
        with limit_megapixels(max_megapixels):
            result = TASKS[kind].run(images, options, folder / "results", report)
        sender.send({"state": "done", **vars(result)})
        return
    except DeepDetectError as error:
        reason = _for_the_page(str(error), images, folder)
    except MemoryError:
        reason = "there is not enough memory for this: use smaller images"
    except OSError as error:
        reason = f"the files cannot be written ({error.strerror or error}): free some space"
    sender.send({"state": "failed", "error": reason})


def _for_the_page(message: str, images: Sequence[SentImage], folder: Path) -> str:
    """Name images and files as the user does, and options as `deepdetect app` does."""
    for number, image in enumerate(images):
        message = message.replace(str(image.path), image.name)
        message = message.replace(f"images[{number}]", image.name)
    for path in (folder / "results", folder):
        message = message.replace(f"{path}{os.sep}", "")
    return message.replace("`max_megapixels`", "--max-megapixels")


def _end_with_the_server() -> None:
    server = parent_process()
    if server is not None:
        server.join()
        if hasattr(os, "killpg"):
            os.killpg(0, signal.SIGKILL)
        os._exit(1)
