"""Does the program for the control compute what the model computes?

A trained model is exported as C without dependencies, compiled, and fed with the rows of a later run one by one, as a
control would. Its prediction is that of the model in Python to a thousandth of a micrometre.
"""

import ctypes
import os
import shutil
import subprocess
import sys
import tempfile

import numpy as np

import thermodrift as td
from docs.gallery.drawing import COLD, GREY, WARM, picture

PLAN = td.Plan(("fuzzy_correlation",), ("ridge",), ("forward",), n_tsps=(4,))
compiler = shutil.which("cc") or sys.exit("export_to_c: no C compiler (cc) on this computer")

with tempfile.TemporaryDirectory() as folder:
    os.environ["THERMODRIFT_HOME"] = f"{folder}/home"
    machine, files = td.sample_year(folder, seed=0)
    td.train(machine, files[:18], channels=["z"], plan=PLAN)
    name = "models:/sample_vmc-z@champion"
    td.export(name, "c", folder)
    library = f"{folder}/sample_vmc.so"
    source = f"{folder}/sample_vmc.c"
    subprocess.run([compiler, "-O2", "-shared", "-fPIC", source, "-o", library, "-lm"], check=True)
    program, model = ctypes.CDLL(library), td.load_model(name)
    (run,) = td.read(files[20], machine)
    predicted_um = td.predict(model, run)["predicted_um"].to_numpy()

    by_c_um, error_um = np.empty(run.n_rows), ctypes.c_double()
    row_of = ctypes.c_double * len(model.channels())
    for k, sample in enumerate(run.table[list(model.channels())].to_numpy()):
        program.sample_vmc_step(row_of(*sample), ctypes.byref(error_um))
        by_c_um[k] = error_um.value

apart_um = np.abs(by_c_um - predicted_um)
print(f"{run.n_rows} rows, prediction up to {predicted_um.max():.0f} µm, apart by {apart_um.max():.1e} µm at most")
assert predicted_um.max() > 50 and apart_um.max() < 1e-3  # µm

labels = {"xlabel": "hours", "ylabel": "error of z, µm"}
with picture(__file__, "The same run by the model in Python and by the program in C", **labels) as ax:
    ax.plot(run.time_s / 3600, run.values("z") - run.values("z")[0], color=GREY, lw=3, label="recorded")
    ax.plot(run.time_s / 3600, predicted_um, color=COLD, label="predicted in Python")
    ax.plot(run.time_s[::6] / 3600, by_c_um[::6], "o", ms=4, color=WARM, label="predicted in C (some rows)")
