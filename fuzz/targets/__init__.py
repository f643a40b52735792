"""What is tried. To add a target, write its `run` in a family and add it to its `TARGETS`."""

from ..case import Target
from . import archives, arrays, calls, cameras, features, files, images, models, places, tiff

TARGETS: dict[str, Target] = {
    target.name: target
    for family in (images, arrays, files, cameras, features, models, archives, tiff, places, calls)
    for target in family.TARGETS
}
