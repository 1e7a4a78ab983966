"""Is it worth to train again when a season arrives?

One model knows the four runs of the winter and stays as it is. The other is trained again before every run, on all that
came before. Both predict the rest of the year, each run before any model has learned from it.
"""

import tempfile

import numpy as np

import thermodrift as td
from docs.gallery.drawing import COLD, WARM, picture

WINTER = 4  # runs

with tempfile.TemporaryDirectory() as folder:
    machine, files = td.sample_year(folder, seed=0)
    batches = td.read(files, machine)
batches.sort(key=lambda b: b.start)


def trained(runs):
    """A transfer function on four points, both learned from these runs."""
    points = td.SELECTORS["fuzzy_correlation"]().select(runs, "z", n_tsp=4)
    return td.FAMILIES["transfer_function"]().fit(runs, points, "z")


def S_um(model, batch):
    """What the model leaves of the z error of a run, as a standard deviation."""
    return np.std(batch.values("z") - batch.values("z")[0] - model.predict(batch))


winter = trained(batches[:WINTER])
later = batches[WINTER:]
kept_um = np.array([S_um(winter, b) for b in later])
renewed_um = np.array([S_um(trained(batches[:k]), batches[k]) for k in range(WINTER, len(batches))])
print(f"mean S of {len(later)} runs: kept {kept_um.mean():.2f} µm, trained again {renewed_um.mean():.2f} µm")
assert renewed_um.mean() < 0.75 * kept_um.mean() and renewed_um.mean() < 2.2  # µm
assert (renewed_um < kept_um).mean() > 0.6

title = "The same runs, predicted before they are learned from"
with picture(__file__, title, ylabel="S of the z error, µm") as ax:
    dates = [b.start for b in later]
    ax.plot(dates, kept_um, "o-", color=WARM, label="model of the winter")
    ax.plot(dates, renewed_um, "o-", color=COLD, label="trained again before every run")
    ax.set_ylim(0, None)
    ax.tick_params(axis="x", labelrotation=30)
