"""A file that is written whole or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from avatarbuild.errors import InputError


@contextlib.contextmanager
def whole_file(path: Path, advice: str = "name another file") -> Iterator[Path]:
    """
    A place beside `path`, of the same suffix; what lies there when the block ends well takes the name `path`.

    Raises InputError, with `advice` on what to do, where it cannot be written: at the beginning, before any work, or at
    the end.
    """
    partial = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        partial.touch()
        yield partial
        partial.replace(path)
    except OSError as error:
        if error.filename not in (None, str(partial), str(path)):
            raise
        raise InputError(f"{path} cannot be written ({error.strerror or error}): {advice}") from None
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
