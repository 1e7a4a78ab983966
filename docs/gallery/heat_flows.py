"""Where does the heat of a machining centre go?

The twin of the sample machine runs for eight hours. Heat that its bearings, motor and belt make is stored in the
castings or lost to air, room and floor; at every moment the three balance.
"""

import tempfile
from pathlib import Path

import numpy as np

import thermodrift as td
from docs.gallery.drawing import COLD, GOLD, GREEN, INK, picture

MACHINE = Path(__file__).parents[2] / "machines" / "sample_vmc.yml"
PLAN = """
step: 2 min
stages: [{minutes: 10, spindle_rpm: 0}, {hours: 6, spindle_rpm: 5000}, {hours: 2, spindle_rpm: 0}]
surroundings: {room: 20 degC}
start: settled
"""

with tempfile.TemporaryDirectory() as folder:
    plan = Path(folder) / "day.yml"
    plan.write_text(PLAN)
    done = td.simulate(MACHINE, plan)
flows = done.heat_flows()
totals = flows.totals().set_index(["kind", "name"])["energy_kJ"]
heat_kJ, stored_kJ, lost_kJ = (totals[kind].sum() for kind in ("heat", "storage", "loss"))
room_kJ = totals["loss", "room"]
print(f"heat {heat_kJ / 1000:.1f} MJ: stored {stored_kJ / heat_kJ:.0%}, to the room {room_kJ / heat_kJ:.0%}")
assert abs(heat_kJ - stored_kJ - lost_kJ) < 1e-3 * heat_kJ  # the balance closes
assert 0.70 < room_kJ / heat_kJ < 0.80 and 0.18 < stored_kJ / heat_kJ < 0.26

hours = flows.time_s[1:] / 3600
stored_W = np.maximum(sum(flows.storage_W.values()), 0)
title = "Heat of the machine at 5000/min, and where it goes"
with picture(__file__, title, xlabel="hours", ylabel="W") as ax:
    ax.fill_between(hours, 0, flows.loss_W["room"], color=COLD, alpha=0.6, label="to the room")
    lost_W = flows.loss_W["room"] + flows.loss_W["floor"]
    ax.fill_between(hours, flows.loss_W["room"], lost_W, color=GREEN, alpha=0.6, label="to the floor")
    ax.fill_between(hours, lost_W, lost_W + stored_W, color=GOLD, alpha=0.6, label="stored in the castings")
    ax.plot(hours, sum(flows.heat_W.values()), color=INK, label="heat of bearings, motor, belt, cabinet")
    ax.set_ylim(0, 1100)
