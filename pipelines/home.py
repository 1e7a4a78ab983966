"""The home folder, which everything is written to. Apart from `pipelines.settings`, whose imports a process that only
waits should not hold in memory."""

from __future__ import annotations

import os
from pathlib import Path


def home() -> Path:
    """The folder that everything is written to: THERMODRIFT_HOME, else var/ in the working directory; absolute."""
    return Path(os.environ.get("THERMODRIFT_HOME", "").strip() or "var").expanduser().resolve()
