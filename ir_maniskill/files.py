"""Files are written aside and renamed: only success replaces what was there before."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a new file's path beside `path`; at the end it takes the place of `path`.

    Args:
        path: The file to write, maybe through a link. Its folder is made if need be.

    Raises:
        OSError: It cannot be written; the file there before is untouched.
    """
    target = path.resolve()
    aside = target.with_name(f".{os.getpid()}.{target.name}")
    try:
        with writing(path):
            target.parent.mkdir(parents=True, exist_ok=True)
            yield aside
            with aside.open("rb") as file:
                os.fsync(file.fileno())
            aside.replace(target)
    finally:
        with contextlib.suppress(OSError):  # else it hides the clear one
            aside.unlink()


def write_json(path: Path, data: Any) -> None:
    """Write plain data as JSON that people can read."""
    with replacing(path) as aside:
        aside.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")


def require_writable(path: Path, endings: Sequence[str] = ()) -> None:
    """Refuse a path before the work is done whose result could not be written there.

    Raises:
        ValueError: The name has none of the endings, such as ".png".
        OSError: It cannot be written.
    """
    if endings and path.suffix.lower() not in endings:
        expected = f"a name ending in {' or '.join(endings)}"
        raise ValueError(f"file: got {path}, expected {expected}")
    target = path.resolve()
    with writing(path):
        new = not target.exists()
        target.parent.mkdir(parents=True, exist_ok=True)
        target.open("ab").close()
        if new:
            target.unlink()


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn whatever keeps `path` from being written into one clear OSError."""
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise OSError("it is no file")  # as root one would replace /dev/null
        yield
    except OSError as error:
        reason = error.strerror or error
        raise OSError(
            f"cannot write {path}: {reason}; free some space or choose another folder "
            "(what was there before is intact)"
        ) from error
