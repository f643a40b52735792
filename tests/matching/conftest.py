"""Matching with all settings by their names, whichever object they belong to."""

from __future__ import annotations

import dataclasses
from typing import Any

from deepdetect import Matches, SelectionOptions, match_images
from deepdetect.geometry import GeometryOptions


def match(image0: Any, image1: Any, detector: Any = None, **settings: Any) -> Matches:
    """Call `match_images`."""
    for argument, kind in (("selection", SelectionOptions), ("options", GeometryOptions)):
        names = [field.name for field in dataclasses.fields(kind)]
        given = {name: settings.pop(name) for name in names if name in settings}
        if given:
            settings[argument] = kind(**given)
    return match_images(image0, image1, detector, **settings)
