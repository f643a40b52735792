"""Data sets: real images with a known truth. A new one is a module here and a line below."""

from collections.abc import Callable

from ..errors import look_up
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
    return look_up("stereo pair", name, STEREO_PAIRS)()


__all__ = ["STEREO_PAIRS", "StereoPair", "load_stereo_pair"]
