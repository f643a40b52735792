"""Damage to files: what disks, networks and editors do, and what a fuzzer tries."""

from __future__ import annotations

import numpy as np

INTERESTING = (0, 1, 0x7F, 0x80, 0xFF)
MAX_MUTATIONS = 8


def mutate(content: bytes, generator: np.random.Generator) -> bytes:
    """Return a copy of a file with up to eight mutations; one in nine has none.

    Args:
        content: the file, not empty.
        generator: of all choices.
    """
    data = bytearray(content)
    for _ in range(int(generator.integers(MAX_MUTATIONS + 1))):
        if not data:
            break
        kind = generator.integers(8)
        at = int(generator.integers(len(data)))
        length = int(min(len(data) - at, 2 ** generator.integers(0, 8)))
        if kind <= 1:
            data[at] ^= 1 << int(generator.integers(8))
        elif kind == 2:
            data[at] = int(generator.choice(INTERESTING))
        elif kind == 3:
            data[at : at + length] = generator.bytes(length)
        elif kind == 4:
            del data[at : at + length]
        elif kind == 5:
            data[at:at] = generator.bytes(length)
        elif kind == 6:  # a piece twice
            data[at:at] = data[at : at + length]
        elif generator.random() < 0.3:  # cut off
            del data[at:]
        else:  # a number of four bytes that is too large
            data[at : at + 4] = (2 ** int(generator.integers(16, 32)) - 1).to_bytes(4, "big")
    return bytes(data)
