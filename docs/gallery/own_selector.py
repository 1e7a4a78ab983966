"""How is a selector of one's own written and compared?

One class: the sensors that correlate best with the error, without those that nearly repeat one in front. It competes
with plain correlation on later runs.
"""

import tempfile

import numpy as np

import thermodrift as td
from docs.gallery.drawing import COLD, GREY, picture
from features.selectors.base import Selector
from features.selectors.statistics import check_n_tsps, in_order, ranking, training_statistics


class Distinct(Selector):
    """By |correlation| with the error, each input behind the rest that nearly repeats one in front of it."""

    key, source, summary = "distinct", "an example", "largest |correlation| among inputs that do not repeat each other"

    def select_design(self, design, train, n_tsps):
        check_n_tsps(design, n_tsps, self.key)
        statistics = training_statistics(design, train, self.key)
        distinct, behind = [], []
        for c in map(int, ranking(np.abs(statistics.with_target), statistics.varying)):
            repeats = not statistics.varying[c] or (np.abs(statistics.between[c, distinct]) > 0.95).any()
            (behind if repeats else distinct).append(c)
        return {n: in_order(design, [*distinct, *behind][:n]) for n in n_tsps}


with tempfile.TemporaryDirectory() as folder:
    machine, files = td.sample_year(folder, seed=0)
    batches = td.read(files, machine)
first, later = batches[:20], batches[20:]


def S_um(selector):
    """What ridge regression leaves of each later run."""
    model = td.FAMILIES["ridge"]().fit(first, selector.select(first, "z", n_tsp=4), "z")
    return [np.std(b.values("z") - b.values("z")[0] - model.predict(b)) for b in later]


own, other = Distinct(), td.SELECTORS["correlation"]()
own_um, other_um = S_um(own), S_um(other)
print(f"S: own {np.mean(own_um):.2f} µm, plain correlation {np.mean(other_um):.2f} µm")
assert np.mean(own_um) < 0.8 * np.mean(other_um)

labels = {"ylabel": "S of the z error, µm", "ylim": (0, 9)}
with picture(__file__, "Ridge regression on four points, later runs", **labels) as ax:
    dates = [b.start for b in later]
    for selector, left_um, color in ((other, other_um, GREY), (own, own_um, COLD)):
        points = ", ".join(selector.select(first, "z", n_tsp=4))
        ax.plot(dates, left_um, "o-", color=color, label=f"{selector.key}: {points}")
