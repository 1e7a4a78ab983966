"""The recordings fit two causes: which run would decide?

Heater 1 gives less heat under load, but whose? In all runs both heaters are on together, so its own power and that of
the other heater explain it alike. The diagnosis proposes one heater alone; there the causes are kelvins apart.
"""

import tempfile
from pathlib import Path

import thermodrift as td
from docs.gallery.board import BOARD, board_runs
from docs.gallery.drawing import COLD, WARM, picture

STAGES = """
  - {{minutes: 1, heater1: 0}}
  - {{minutes: 8, heater1: {0}, heater2: {0}}}
  - {{minutes: 8, heater1: {1}, heater2: {1}}}
  - {{minutes: 8, heater1: 0, heater2: 0}}
"""
POWERS = [(60, 30, 20), (20, 80, 21), (80, 40, 22), (30, 100, 23), (100, 50, 24), (50, 20, 25)]  # %, %, degC

with tempfile.TemporaryDirectory() as folder:
    text, lacking = BOARD.read_text(), Path(folder) / "lacking.yml"
    lacking.write_text(text[: text.index("    sag1:")] + text[text.index("    sag2:") :])
    recorded = board_runs(POWERS, stages=STAGES)
    diagnosis = td.diagnose(lacking, recorded)

    plan = Path(folder) / "next_run.yml"
    plan.write_text(diagnosis.plan_text)
    own = Path(folder) / "own.yml"
    own.write_text(text.replace("drivers: {other: heater2}", "drivers: {other: heater1}"))
    by_other, by_own = (td.simulate(machine, plan).batch for machine in (BOARD, own))

proposed = diagnosis.findings.next_experiment
assert diagnosis.findings.findings[0].mechanism == "supply_sag"
assert len(proposed.separates) >= 2 and "alone" in proposed.run
apart_K = abs(by_other.values("temperature1") - by_own.values("temperature1"))
assert apart_K.max() > 3.0 > 20 * 0.1  # K; a sensor has 0.1 K of noise
print(f"{proposed.run}: apart by up to {apart_K.max():.1f} K")

title = f"The proposed run: {proposed.run}"
with picture(__file__, title, xlabel="minutes", ylabel="temperature of heater 1, °C") as ax:
    for label, run, color in (("the other heater", by_other, COLD), ("its own power", by_own, WARM)):
        ax.plot(run.time_s / 60, run.values("temperature1"), color=color, label=f"if the sag comes from {label}")
