"""Runs scripts of the gallery one by one, each in a process of its own, and renews their pictures.

`python -m docs.gallery` runs all, `python -m docs.gallery NAME …` some. Exit code 1: one failed; 2: an unknown name.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence

from docs.gallery import FOLDER, names


def main(wanted: Sequence[str]) -> int:
    """Runs the scripts; prints a line for each with its seconds, and the error of one that fails."""
    unknown = [name for name in wanted if name not in names()]
    if unknown:
        print(f"gallery: no script {', '.join(unknown)}; there are {', '.join(names())}", file=sys.stderr)
        return 2
    failed = [name for name in wanted or names() if not run(name)]
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def run(name: str) -> bool:
    """Whether the script ended without an error; prints its line."""
    started = time.monotonic()
    command = [sys.executable, str(FOLDER / f"{name}.py")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    said = done.stdout.strip().splitlines()
    state = said[-1] if said and done.returncode == 0 else "ok" if done.returncode == 0 else "FAILED"
    print(f"{name:<22} {time.monotonic() - started:5.1f} s  {state}", flush=True)
    if done.returncode:
        print(done.stderr[-3000:], file=sys.stderr, flush=True)
    return done.returncode == 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
