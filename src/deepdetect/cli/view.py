"""`deepdetect view`: results in a browser."""

from __future__ import annotations

import tempfile
import webbrowser
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from .._shared.errors import MissingFileError, OptionError
from ..io.image import load_image
from ..io.picture_file import save_picture
from ..io.tables import load_keypoints, load_matches
from . import _options as cli

SHOWN = (".html", ".jpg", ".jpeg", ".png", ".webp", ".gif", ".svg", ".pdf")
"""Suffixes of files that browsers can display."""


@cli.command()
def view(
    file: Annotated[Path, Parameter(help="A file that another command wrote.")],
    /,
    *images: Annotated[
        Path, Parameter(help="The image of the keypoints, or both images of the matches.")
    ],
) -> cli.Result:
    """Show a result in the browser.

    Pages and images are shown as they are. For a point cloud or a depth map, the page or image with
    the same name next to it is shown. Keypoints and matches are drawn on their images.

        deepdetect view model.ply
        deepdetect view left.npz left.png
        deepdetect view left_right_matches.npz left.png right.png
    """
    if not file.is_file():
        what = "a folder" if file.is_dir() else "no file"
        raise MissingFileError(f"{file} is {what}: give a file that another command wrote")
    numbers: dict[str, object] = {}
    if len(images) > 2:
        raise OptionError("give one image for keypoints, or two for matches")
    if images:
        result = load_keypoints(file) if len(images) == 1 else load_matches(file)
        picture = result.draw(*map(load_image, images))
        shown = Path(tempfile.mkdtemp(prefix="deepdetect-"), file.stem + ".png")
        save_picture(picture, shown)
        numbers["keypoints" if len(images) == 1 else "matches"] = len(result)
    else:
        beside = (file, file.with_suffix(".html"), file.with_suffix(".jpg"))
        found = [path for path in beside if path.suffix.lower() in SHOWN and path.is_file()]
        if not found:
            raise OptionError(
                f"a browser cannot display {file}: open a video with a player, and give the images "
                "of keypoints or matches, as in deepdetect view FILE IMAGE ..."
            )
        shown = found[0]
    if not webbrowser.open(shown.absolute().as_uri()):
        cli.say(f"no browser was found: open {shown} in one")
    return cli.Result({**numbers, "shown": shown})
