"""1. The chain by hand: read recordings, choose points, fit, predict the batch that was left out.

Simulated recordings of the sample machine; put your own machine file and folder in their place.
"""

import tempfile

import thermodrift as td

with tempfile.TemporaryDirectory() as folder:
    machine, recordings = td.sample_year(folder, seed=0)
    *train, left_out = td.read(recordings, machine)

points = td.SELECTORS["fuzzy_correlation"]().select(train, "z", n_tsp=4)
model = td.FAMILIES["ridge"]().fit(train, points, "z")
recorded_um = left_out.values("z") - left_out.values("z")[0]
error_um = recorded_um - model.predict(left_out)

print(f"{left_out.batch_id} (simulated) by {', '.join(points)}: {recorded_um.std():.1f} → {error_um.std():.1f} µm")
assert error_um.std() < 0.3 * recorded_um.std()
