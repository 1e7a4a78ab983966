"""Texts that tests hold as files, next to the test in ``snapshots/NAME.txt``.

THERMODRIFT_UPDATE_SNAPSHOTS=1 writes them anew; the diff then shows what changed for the reader.
"""

from __future__ import annotations

import os
from pathlib import Path


def check_snapshot(test_file: str, name: str, text: str) -> None:
    """Compare a text with its file."""
    path = Path(test_file).with_name("snapshots") / f"{name}.txt"
    if os.environ.get("THERMODRIFT_UPDATE_SNAPSHOTS"):
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")
    assert text == path.read_text(encoding="utf-8"), f"{path} differs; see tests/snapshots.py"
