"""Files that appear whole under their final name, or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

from .errors import DeepDetectError


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside the final one, which is renamed when the block succeeds.

    Args:
        path: the final path. Missing folders are created. The temporary name keeps the suffix,
            by which many writers choose the format.

    Yields:
        The temporary path, which the block writes.

    Raises:
        DeepDetectError: the file cannot be written (no permission, no space, not a folder).

    Example:
        >>> import tempfile
        >>> target = Path(tempfile.mkdtemp()) / "out.txt"
        >>> with atomic_path(target) as temporary:
        ...     _ = temporary.write_text("whole")
        >>> target.read_text()
        'whole'
    """
    final = Path(path)
    temporary: Path | None = None
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            prefix=f".{final.stem}.", suffix=f".part{final.suffix}", dir=final.parent
        )
        os.close(handle)
        temporary = Path(name)
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(final)
    except OSError as error:
        raise DeepDetectError(
            f"cannot write {final} ({error.strerror or error}): "
            "free some space, or choose another place"
        ) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


@lru_cache(maxsize=1)
def _umask() -> int:
    """Return the mode bits that new files lack: mkstemp creates private files."""
    umask = os.umask(0o077)  # it can only be read by setting it
    os.umask(umask)
    return umask
