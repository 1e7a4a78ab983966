"""How does the error of a feed axis change along its travel as the screw warms?

A lathe's Z axis is read at twelve positions again and again. The model learns an offset and a slope, the straight line
that a control can compensate, and predicts the fan of a run that it has not seen.
"""

import tempfile
from pathlib import Path

import numpy as np
from matplotlib import colormaps

import thermodrift as td
from docs.gallery.drawing import picture
from thermodrift_exam.plants.types.lathe_axis import write_sample_axis

MACHINE = Path(__file__).parents[2] / "machines" / "sample_lathe.yml"

with tempfile.TemporaryDirectory() as folder:
    *train, run = td.read(write_sample_axis(Path(folder), seed=0), MACHINE)
inputs = td.SELECTORS["fuzzy_correlation"]().select(train, "z_axis", n_tsp=5)
model = td.FAMILIES["axis_coupled"]().fit(train, inputs, "z_axis")
predicted_um = model.predict(run)
position_mm, read_um = run.values("z_position"), run.values("z_axis")
read = np.isfinite(read_um)
left_um = (read_um - predicted_um)[read]
print(f"rms along the axis: {np.sqrt(np.mean(read_um[read] ** 2)):.1f} µm, with the model {left_um.std():.1f} µm")
assert read.sum() == 132 and np.abs(read_um[read]).max() > 20  # µm
assert left_um.std() < 0.3 * read_um[read].std()

sweeps = np.split(np.flatnonzero(read), np.flatnonzero(np.diff(np.flatnonzero(read)) > 1) + 1)
labels = {"xlabel": "position of the Z axis, mm", "ylabel": "error of Z, µm"}
with picture(__file__, "Readings (dots) and prediction (lines) as the screw warms", **labels) as ax:
    for k, sweep in enumerate(sweeps[1::2]):
        hours = run.time_s[sweep[0]] / 3600
        color = colormaps["plasma"](0.22 * k)
        ax.plot(position_mm[sweep], read_um[sweep], "o", ms=4, color=color)
        ax.plot(position_mm[sweep], predicted_um[sweep], color=color, label=f"{hours:.1f} h")
