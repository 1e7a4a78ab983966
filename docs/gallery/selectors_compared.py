"""Which four of ten temperature sensors should the model read?

Eight selectors pick four points each from the first twenty runs of a year; ridge regression on them is
judged on the ten later runs. Fewer sensors can do almost as well as all; the wrong ones cost three times the error.
"""

import tempfile

import numpy as np

import thermodrift as td
from docs.gallery.drawing import COLD, GREY, picture

SELECTORS = ("fuzzy_correlation", "sequential_forward", "vif_pruning", "elastic_net_path", "correlation", "fcgc",
             "kmedoids", "fcm_grey", "none")  # fmt: skip

with tempfile.TemporaryDirectory() as folder:
    machine, files = td.sample_year(folder, seed=0)
    batches = td.read(files, machine)
batches.sort(key=lambda b: b.start)
first, later = batches[:20], batches[20:]


def S_um(model, batch):
    """What the model leaves of the z error of a run, as a standard deviation."""
    return np.std(batch.values("z") - batch.values("z")[0] - model.predict(batch))


left_um, label = {}, {}
for key in SELECTORS:
    points = td.SELECTORS[key]().select(first, "z", n_tsp=4)
    model = td.FAMILIES["ridge"]().fit(first, points, "z")
    left_um[key] = np.mean([S_um(model, b) for b in later])
    label[key] = f"{key}\n{'all ten' if key == 'none' else ', '.join(points)}"
    print(f"{key:<20} {left_um[key]:5.2f} µm  {', '.join(points)}")

print(f"all ten {left_um['none']:.2f} µm; four: {left_um['fuzzy_correlation']:.2f} to {left_um['fcm_grey']:.2f} µm")
assert left_um["none"] < 2.2 and left_um["fuzzy_correlation"] < 3.5  # µm
assert left_um["fcm_grey"] > 2 * left_um["fuzzy_correlation"]

order = sorted(SELECTORS, key=lambda key: left_um[key])
title = "Ridge regression on four points: later runs"
with picture(__file__, title, xlabel="S of the z error, mean of ten runs, µm") as ax:
    for key in order:
        ax.barh(label[key], left_um[key], color=GREY if key == "none" else COLD)
    ax.tick_params(axis="y", labelsize=8)
    ax.invert_yaxis()
