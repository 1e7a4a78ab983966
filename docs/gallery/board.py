"""Runs of a laboratory board with two heaters, simulated: recordings for the gallery's questions about the twin."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import thermodrift as td
from data.batch import Batch

BOARD = Path(__file__).parents[2] / "machines" / "tclab_board.yml"
STAGES = """
  - {{minutes: 7, heater1: {0}}}
  - {{minutes: 6, heater2: {1}}}
  - {{minutes: 6, heater1: {1}}}
  - {{minutes: 6, heater1: 0, heater2: 0}}
"""


def board_runs(
    powers: Sequence[tuple[float, float, float]], machine: Path = BOARD, stages: str = STAGES
) -> list[Batch]:
    """One run, with noise, for each of `powers`: two powers in % (in `stages` {0} and {1}) and the room in °C."""
    with tempfile.TemporaryDirectory() as folder:
        recorded = []
        for k, (one, other, room) in enumerate(powers):
            named = Path(folder) / f"run{k}.yml"
            named.write_text(f"step: 10 s\nstages:{stages.format(one, other)}surroundings: {{room: {room} degC}}\n")
            recorded.append(td.simulate(machine, named, noise=True, seed=k).batch)
    return recorded
