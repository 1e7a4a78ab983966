"""A value in the machine file is wrong: which one?

The file says that 1 mW/K flow between the heaters; 3 mW/K made the recordings. No effect is missing, so the diagnosis
blames the value, gives the right one with its interval, and keeps what it cannot rule out as alternatives.
"""

import tempfile
from pathlib import Path

import thermodrift as td
from docs.gallery.board import BOARD, board_runs
from docs.gallery.drawing import COLD, GREEN, WARM, picture

POWERS = [(60, 30, 20), (20, 80, 22), (80, 40, 24), (30, 100, 26)]  # %, %, degC

with tempfile.TemporaryDirectory() as folder:
    recorded = board_runs(POWERS)
    wrong = Path(folder) / "wrong.yml"
    stated = "heater1-heater2: {value: 3 mW/K, spread: 0.7"
    assert stated in BOARD.read_text()
    wrong.write_text(BOARD.read_text().replace(stated, "heater1-heater2: {value: 1 mW/K"))
    findings = td.diagnose(wrong, recorded).findings

(found,) = findings.findings
assert found.mechanism == "wrong_parameter" and found.where.name == "heater1-heater2" and found.probability > 0.6
(conductance,) = found.parameters.values()
low, high = (1000 * limit for limit in conductance.interval90)  # mW/K
assert low < 3.05 and high > 2.95 and high - low < 0.2
print(found.statement)

with picture(__file__, "Conductance between the heaters", xlabel="mW/K", xlim=(0, 4), ylim=(-0.6, 2.6)) as ax:
    ax.plot(1.0, 2, "o", color=WARM)
    ax.errorbar(1000 * conductance.value, 1, xerr=(high - low) / 2, fmt="o", color=COLD, capsize=5)
    ax.plot(3.0, 0, "o", color=GREEN)
    ax.set_yticks([2, 1, 0], ["stated in\nthe file", "found, with its\n90 % interval", "that made the\nrecordings"])
