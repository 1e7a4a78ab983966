"""`thermodrift schedule FLEET` that ends after one run: `python -m tests.toys.one_round FLEET`."""

from __future__ import annotations

import sys
from pathlib import Path

from pipelines import stopping

FLEET = """
machines:
  - machine: {machine}
    recordings: [{recordings}]
    when: {{watch: true, quiet_min: 0}}
    channels: [z]
    families: [zero, mlr]
    selectors: [none]
"""


def write_fleet(path: Path, machine: Path, recordings: Path) -> Path:
    """A fleet of one machine that is retrained at once, with a small plan."""
    path.write_text(FLEET.format(machine=machine, recordings=recordings), encoding="utf-8")
    return path


def main() -> None:
    from pipelines.fleet.fleet_file import load_fleet
    from pipelines.fleet.service import local_timezone, serve_fleet
    from pipelines.home import home

    serve_fleet(load_fleet(Path(sys.argv[1]), local_timezone()), home(), lambda text: print(text, flush=True), rounds=1)


if __name__ == "__main__":
    with stopping.prompt():
        main()
