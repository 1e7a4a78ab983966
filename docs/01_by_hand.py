"""1. The chain by hand: read recordings, choose points, fit, predict the batch that was left out.

Simulated recordings of the sample machine; put your own machine file and folder in their place.
"""

import tempfile
from pathlib import Path

import numpy as np

from data.machine import load_machine
from data.recording import read_batches
from features.selectors.fuzzy_correlation import FuzzyCorrelation
from models.metrics import residual_std_um
from models.ridge import Ridge
from plants.sample.sample_year import write_sample_year

machine = load_machine(Path(__file__).parent.parent / "machines" / "sample_vmc.yml")
with tempfile.TemporaryDirectory() as folder:
    files = write_sample_year(Path(folder), seed=0)
    batches = [batch for file in files for batch in read_batches(file, machine)]

*train, left_out = batches
points = FuzzyCorrelation().select(train, "z", n_tsp=4)
model = Ridge().fit(train, points, "z")

recorded_um = left_out.values("z") - left_out.values("z")[0]
error_um = recorded_um - model.predict(left_out)
S_before_um, S_after_um = residual_std_um(recorded_um), residual_std_um(error_um)

print(f"points          {', '.join(points)}")
print(f"left-out batch  {left_out.batch_id} (simulated), {left_out.n_rows} rows")
print(f"S               {S_before_um:.1f} µm as recorded, {S_after_um:.1f} µm after the model")
assert np.isfinite(S_after_um) and S_after_um < 0.3 * S_before_um
