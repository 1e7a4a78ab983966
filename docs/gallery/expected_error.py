"""How large will the error be, before anybody measures it?

A model of the runs from January to July states for every later run the error S that it expects and a bound that nine
runs in ten stay below. Runs outside the trained region are flagged and get a wider bound.
"""

import os
import tempfile

import numpy as np

import thermodrift as td
from docs.gallery.drawing import COLD, GREY, WARM, picture

PLAN = td.Plan(("fuzzy_correlation",), ("transfer_function",), ("forward",), n_tsps=(4,))

with tempfile.TemporaryDirectory() as folder:
    os.environ["THERMODRIFT_HOME"] = f"{folder}/home"
    machine, files = td.sample_year(folder, seed=0)
    td.train(machine, files[:16], channels=["z"], plan=PLAN)
    model = td.load_model("models:/sample_vmc-z@champion")
    later = td.read(files[16:], machine)
    tables = [td.predict(model, batch) for batch in later]

recorded_um = [b.values("z") - b.values("z")[0] for b in later]
S_um = np.array([np.std(r - t["predicted_um"]) for r, t in zip(recorded_um, tables, strict=True)])
bound_um, expected_um = (np.array([t[c].iloc[0] for t in tables]) for c in ("bound90_S_um", "expected_S_um"))
outside = np.array([t["outside_region"].any() for t in tables])
below = (S_um < bound_um).mean()
print(f"{below:.0%} of {len(later)} later runs below their bound; {outside.sum()} outside the trained region")
assert below >= 0.85
assert 1.0 < expected_um.mean() < 3.0 and 1.0 < S_um.mean() < 3.0  # µm
assert 1 <= outside.sum() <= 6 and bound_um[outside].min() > bound_um[~outside].max()

dates = np.array([b.start for b in later])
with picture(__file__, "Stated before the run, and measured in it", ylabel="S of the z error, µm", ylim=(0, 6)) as ax:
    ax.vlines(dates, 0, bound_um, color=GREY, lw=5, alpha=0.5, label="below the 90 % bound")
    ax.plot(dates[~outside], S_um[~outside], "o", color=COLD, label="measured")
    ax.plot(dates[outside], S_um[outside], "D", color=WARM, label="measured, outside the trained region")
    ax.tick_params(axis="x", labelrotation=30)
