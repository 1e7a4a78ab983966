"""Heat that no law of the library makes: what does the diagnosis say?

A heater gives more heat the warmer it is, which no listed mechanism does. The verdict is "unlisted": no name is forced
on it, but place, driver and law are stated with the coefficient, which is the one that made the recordings.
"""

import tempfile
from pathlib import Path

import numpy as np

import thermodrift as td
from docs.gallery.board import BOARD, board_runs
from docs.gallery.drawing import COLD, GOLD, INK, WARM, picture

POWERS = [(60, 30, 20), (20, 80, 22), (80, 40, 24), (30, 100, 26)]  # %, %, degC

HIDDEN = """
    hidden: {law: free_flux, into: heater1, at: {body: heater1}, drivers: {level: heater1}, parameters: {product: 0.1 mW/K}}
"""  # noqa: E501

with tempfile.TemporaryDirectory() as folder:
    truth = Path(folder) / "truth.yml"
    truth.write_text(BOARD.read_text().replace("  mechanisms:\n", "  mechanisms:" + HIDDEN))
    recorded = board_runs(POWERS, truth)
    findings = td.diagnose(BOARD, recorded).findings

(found,) = findings.findings
product = found.parameters["product"]
assert findings.verdict == "unlisted" and (found.mechanism, found.where.name) == ("free_flux", "heater1")
assert abs(product.value - 1e-4) < 5e-6  # W/K for each % of the heater's setting
print(found.statement)

warm_degC = np.array([20.0, 100.0])
labels = {"xlabel": "temperature of heater 1, °C", "ylabel": "unlisted heat, mW"}
with picture(__file__, "The law that was found, and the one that made the recordings", **labels) as ax:
    for percent, color in ((100, WARM), (60, GOLD), (30, COLD)):
        ax.plot(warm_degC, 1000 * product.value * percent * (warm_degC - 20), color=color, label=f"found, {percent} %")
        ax.plot(warm_degC[1:], 1000 * 1e-4 * percent * (warm_degC[1:] - 20), "o", color=color, clip_on=False)
    ax.plot([], [], "o", color=INK, label="true, at 100 °C")
