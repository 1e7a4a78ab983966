"""What are touch-probe readings worth while the machine is being compensated?

A model of the first runs of a year compensates two later ones, played back as if they happened now: without readings,
and with one probe reading an hour, from which the correction learns what the model does not know about this run.
"""

import os
import tempfile

import thermodrift as td
from docs.gallery.drawing import COLD, GREY, WARM, picture

PLAN = td.Plan(("fuzzy_correlation",), ("ridge",), ("forward",), n_tsps=(4,))

with tempfile.TemporaryDirectory() as folder:
    os.environ["THERMODRIFT_HOME"] = f"{folder}/home"
    machine, files = td.sample_year(folder, seed=0)
    td.train(machine, files[:18], channels=["z"], plan=PLAN)
    model = "models:/sample_vmc-z@champion"
    alone = td.rehearse(model, files[18:20], sample_s=20)
    learning = td.rehearse(model, files[18:20], sample_s=20, readings_h=1.0)

before_um, alone_um = alone.rms_um("z")
_, learning_um = learning.rms_um("z")
print(f"rms of z: {before_um:.1f} µm, compensated {alone_um:.1f} µm, with readings {learning_um:.1f} µm")
assert alone_um < 0.35 * before_um
assert learning_um < 0.85 * alone_um
assert len(learning.readings_s) >= 10 and not alone.readings_s

hours = alone.time_s / 3600
title = "Two runs that the model has not seen"
with picture(__file__, title, xlabel="hours", ylabel="error of z, µm") as ax:
    ax.plot(hours, alone.before_um["z"], color=GREY, label="without compensation")
    ax.plot(hours, alone.after_um["z"], color=WARM, label="compensated")
    ax.set_ylim(-15, 135)
    ax.plot(hours, learning.after_um["z"], color=COLD, lw=1, label="compensated, one probe reading an hour")
