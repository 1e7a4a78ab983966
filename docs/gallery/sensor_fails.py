"""A sensor fails while the machine is compensated: what happens to the error?

The cable of a sensor breaks for 45 minutes in the middle of a run. The compensation replaces it by the regression on
the other sensors and stays active: the error grows by some micrometres, and comes back with the sensor.
"""

import os
import tempfile

import numpy as np

import thermodrift as td
from docs.gallery.drawing import COLD, GREY, PALE, WARM, picture

PLAN = td.Plan(("fuzzy_correlation",), ("ridge",), ("forward",), n_tsps=(4,))

with tempfile.TemporaryDirectory() as folder:
    os.environ["THERMODRIFT_HOME"] = f"{folder}/home"
    machine, files = td.sample_year(folder, seed=0)
    td.train(machine, files[:18], channels=["z"], plan=PLAN)
    model = "models:/sample_vmc-z@champion"
    whole = td.rehearse(model, files[20], sample_s=20)
    failing = td.rehearse(model, files[20], sample_s=20, failures=["rear:lost@3h+45min"])

hours = whole.time_s / 3600
during = (hours > 3.0) & (hours < 3.75)
largest_um = {
    name: np.abs(error_um["z"][during]).max()
    for name, error_um in (("none", whole.before_um), ("whole", whole.after_um), ("failing", failing.after_um))
}
print("largest error while it is lost, µm:", {name: round(float(v), 1) for name, v in largest_um.items()})
assert any("rear lost, replaced" in reason for reason in failing.reason["z"])
assert set(np.array(failing.state["z"])[during]) == {"active"}
assert largest_um["whole"] < 4.0 and largest_um["failing"] < 0.25 * largest_um["none"]  # µm

title = "The sensor at the rear bearing is lost for 45 minutes"
with picture(__file__, title, xlabel="hours", ylabel="error of z, µm") as ax:
    ax.axvspan(3.0, 3.75, color=PALE, zorder=0, label="sensor lost")
    ax.plot(hours, whole.before_um["z"], color=GREY, label="without compensation")
    ax.plot(hours, failing.after_um["z"], color=WARM, label="compensated, sensor lost")
    ax.plot(hours, whole.after_um["z"], color=COLD, label="compensated, all sensors")
