"""What would a thermal acceptance test of this machine show?

The machine file's twin runs the rotating-spindle test of ISO 230-3 at 4000/min: four hours of heat, then cooling. The
quantities of the standard, the range of each axis and its change after 60 minutes, come from the simulated recording.
"""

import tempfile
from pathlib import Path

import thermodrift as td
from docs.gallery.drawing import COLD, GREEN, PALE, WARM, picture
from features.iso230_3 import thermal_test

MACHINE = Path(__file__).parents[2] / "machines" / "sample_vmc.yml"
PLAN = """
step: 60 s
stages: [{minutes: 5, spindle_rpm: 0}, {hours: 4, spindle_rpm: 4000}, {hours: 1, spindle_rpm: 0}]
surroundings: {room: {start: 20 degC, drift: 0.2 K/h}}
start: settled
"""

with tempfile.TemporaryDirectory() as folder:
    plan = Path(folder) / "spindle_test.yml"
    plan.write_text(PLAN)
    run = td.simulate(MACHINE, plan, noise=True, seed=1).batch
test = thermal_test(run)
heating, cooling = test.periods
rise_um = {axis: test.value(axis, "d(60 min)", heating.name) for axis in ("X", "Y", "Z")}
print(f"d(60 min) at 4000/min: {rise_um} µm; range of Z: {test.value('Z', 'range', heating.name):.0f} µm")
assert abs(rise_um["Z"] - 49) <= 3 and abs(rise_um["Y"] - 11) <= 3 and abs(rise_um["X"]) <= 8  # µm
assert test.value("Z", "d(t)", cooling.name) < -30  # it comes back while the spindle stands

hours = run.time_s / 3600
with picture(__file__, test.title, xlabel="hours", ylabel="displacement, µm") as ax:
    for axis, color in (("z", WARM), ("y", COLD), ("x", GREEN)):
        shift_um = run.values(axis) - run.values(axis)[0]
        ax.plot(hours, shift_um, color=color, label=f"{axis.upper()}, d(60 min) {rise_um[axis.upper()]:+.0f} µm")
    ax.axvspan(heating.start_s / 3600, heating.end_s / 3600, color=PALE, zorder=0, label="spindle at 4000/min")
    ax.set_ylim(-10, 75)
