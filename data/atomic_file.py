"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path
from uuid import uuid4


def write_atomic(path: Path, content: str | bytes) -> None:
    """Put the content (text as UTF-8, lines as they are) at `path` in one step; on failure what stood there stays.

    The folder must exist.

    Raises:
        OSError: it cannot be written.
    """
    scratch = path.with_name(f".{path.name}.{uuid4().hex}.part")
    try:
        with scratch.open("wb") as file:
            file.write(content.encode("utf-8") if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        scratch.replace(path)
    finally:
        scratch.unlink(missing_ok=True)
