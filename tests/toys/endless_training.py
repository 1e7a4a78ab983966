"""`thermodrift ARGS` with one family more, "endless", whose fit never ends.

With ENDLESS=here it counts as closed-form, so that it runs in a thread of the command and not in a worker.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from typing import Any

from features.design import Design
from models.families import FAMILIES
from models.families.mlr import MLR
from pipelines.cli import main

FAMILIES.add("endless", "tests.toys.endless_training:Endless")


class Endless(MLR):
    """Compiled code that no signal handler of Python interrupts."""

    closed_form = os.environ.get("ENDLESS") == "here"

    def fit_subsets(self, designs: Sequence[Design], folds: Sequence[Any]) -> Any:
        hashlib.pbkdf2_hmac("sha256", b"", b"", 2_000_000_000)


if __name__ == "__main__":
    main()
