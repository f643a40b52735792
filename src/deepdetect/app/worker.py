"""The process that does one task: `python -m deepdetect.app.worker FOLDER`.

It reads task.json of the folder, writes its files to `results`, and tells by lines of JSON on
standard output how far it is. It ends when its standard input does, with all that it has started.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from pathlib import Path
from typing import Any

from .._shared.errors import DeepDetectError
from .tasks import TASKS, SentImage


def main(folder: Path) -> None:
    """Do the task of a folder."""
    from ..io.image_file import limit_megapixels

    # What libraries print must not come between the lines of JSON.
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    threading.Thread(target=_end_with_the_server, daemon=True).start()

    def tell(**values: Any) -> None:
        out.write(json.dumps(values) + "\n")
        out.flush()

    task = json.loads((folder / "task.json").read_text(encoding="utf-8"))
    images = [SentImage(folder / file, name) for file, name in task["images"]]
    results = folder / "results"
    results.mkdir()
    try:
        with limit_megapixels(task["max_megapixels"]):
            result = TASKS[task["kind"]].run(
                images,
                task["options"],
                results,
                lambda stage, done, total: tell(stage=stage, done=done, total=total),
            )
        tell(result=vars(result))
    except DeepDetectError as error:
        tell(error=_for_the_page(str(error), images, folder))
    except MemoryError:
        tell(error="there is not enough memory for this: use smaller images")
    except OSError as error:
        tell(error=f"the files cannot be written ({error.strerror or error}): free some space")


def _for_the_page(message: str, images: list[SentImage], folder: Path) -> str:
    """Name images and files as the user does, and options as `deepdetect app` does."""
    for number, image in enumerate(images):
        message = message.replace(str(image.path), image.name)
        message = message.replace(f"images[{number}]", image.name)
    for path in (folder / "results", folder):
        message = message.replace(f"{path}{os.sep}", "")
    return message.replace("`max_megapixels`", "--max-megapixels")


def _end_with_the_server() -> None:
    while os.read(0, 4096):
        pass
    if hasattr(os, "killpg") and os.getpid() == os.getpgrp():
        os.killpg(0, signal.SIGKILL)
    os._exit(1)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
