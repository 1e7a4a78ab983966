"""How is a diagnosis read by another program?

`findings.json` is plain data: pandas makes tables of it. Here two things are missing, a heat path that the library
knows and a heat that it does not; the first is named, the second measured, and the verdict is "partly explained".
"""

import json
import tempfile
from pathlib import Path

import pandas as pd

import thermodrift as td
from docs.gallery.board import BOARD, board_runs
from docs.gallery.drawing import COLD, GREY, WARM, picture

POWERS = [(60, 30, 20), (20, 80, 22), (80, 40, 24), (30, 100, 26)]  # %, %, degC
HIDDEN = """
    hidden: {law: free_flux, into: heater1, at: {body: heater1}, drivers: {level: heater1}, parameters: {product: 0.1 mW/K}}
"""  # noqa: E501

with tempfile.TemporaryDirectory() as folder:
    text = BOARD.read_text()
    truth, lacking = Path(folder) / "truth.yml", Path(folder) / "lacking.yml"
    truth.write_text(text.replace("  mechanisms:\n", "  mechanisms:" + HIDDEN))
    lacking.write_text(text[: text.index("  links:")] + text[text.index("  exposures:") :])
    recorded = board_runs(POWERS, truth)
    td.diagnose(lacking, recorded, out=Path(folder) / "out")
    read = json.loads((Path(folder) / "out" / "findings.json").read_text())

found = pd.json_normalize(read["findings"])[["mechanism", "where.name", "probability"]]
errors = pd.DataFrame(read["fit"]["left_out_rms"])  # a row for each channel
print(found.to_string(index=False))
assert read["verdict"] == "partly_explained"
assert set(found["mechanism"]) == {"free_flux", "heat_bridge"} and (found["probability"] > 0.3).all()
assert (errors["before"] > 10 * errors["after"]).all() and (errors["after"] < 1.5 * errors["noise_floor"]).all()

columns = {"before": ("as in the file, recalibrated", WARM), "after": ("with what was found", COLD),
           "noise_floor": ("noise alone", GREY)}  # fmt: skip
with picture(__file__, "Error of runs that were left out of the fit", ylabel="rms, K", yscale="log") as ax:
    for k, (column, (label, color)) in enumerate(columns.items()):
        ax.bar([0.8 * row + 0.22 * k for row in range(len(errors))], errors[column], 0.2, color=color, label=label)
    ax.set_xticks([0.22, 1.02], [key.removesuffix("_K") for key in errors.index])
    ax.set_ylim(0.05, 100)
