"""Data sets: real images with a known truth. A new one is a module here and a line below."""

from collections.abc import Callable

from ..errors import unknown_name
from .motorcycle import load_motorcycle
from .stereo import StereoPair

STEREO_PAIRS: dict[str, Callable[[], StereoPair]] = {
    "motorcycle": load_motorcycle,
}


def load_stereo_pair(name: str) -> StereoPair:
    """Load a stereo pair by name.

    Raises:
        OptionError: the name is unknown.
    """
    if name not in STEREO_PAIRS:
        raise unknown_name("stereo pair", name, STEREO_PAIRS)
    return STEREO_PAIRS[name]()


__all__ = ["STEREO_PAIRS", "StereoPair", "load_stereo_pair"]
