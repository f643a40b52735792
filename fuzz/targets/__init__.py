"""What is tried. To add a target, write its `run` in a family and add it to its `TARGETS`."""

from ..case import Target
from . import archives, arrays, features, files, images, models

TARGETS: dict[str, Target] = {
    target.name: target
    for family in (images, arrays, files, features, models, archives)
    for target in family.TARGETS
}
