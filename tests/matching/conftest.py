"""Matching with all settings by their names, whichever object they belong to."""

from __future__ import annotations

import dataclasses
from typing import Any

from deepdetect import Matches, MatchingOptions, SelectionOptions, match_images
from deepdetect.geometry import GeometryOptions


def match(image0: Any, image1: Any, detector: Any = None, **settings: Any) -> Matches:
    """Call `match_images`."""

    def taken(kind: type) -> dict[str, Any]:
        names = [field.name for field in dataclasses.fields(kind)]
        return {name: settings.pop(name) for name in names if name in settings}

    if selection := taken(SelectionOptions):
        settings["selection"] = SelectionOptions(**selection)
    if geometry := taken(GeometryOptions):
        settings["geometry"] = GeometryOptions(**geometry)
    if changes := taken(MatchingOptions):
        options = settings.get("options", MatchingOptions())
        settings["options"] = dataclasses.replace(options, **changes)
    return match_images(image0, image1, detector, **settings)
