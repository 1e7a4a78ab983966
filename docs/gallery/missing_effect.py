"""A simulation lacks an effect: which one?

Two heaters stand on one board, and the machine file does not know that heat flows between them. The diagnosis names
the path with its conductance; the error of runs that were left out of the fit falls to the noise of the sensors.
"""

import tempfile
from pathlib import Path

import thermodrift as td
from docs.gallery.board import BOARD, board_runs
from docs.gallery.drawing import COLD, WARM, picture

POWERS = [(60, 30, 20), (20, 80, 21), (80, 40, 22), (30, 100, 23), (100, 100, 24), (50, 20, 25)]  # %, %, degC

with tempfile.TemporaryDirectory() as folder:
    recorded = board_runs(POWERS)

    text = BOARD.read_text()
    start, end = text.index("  links:"), text.index("  exposures:")
    lacking = Path(folder) / "lacking.yml"
    lacking.write_text(text[:start] + text[end:])
    found = td.diagnose(lacking, recorded)

findings = found.findings
(path,) = findings.findings
conductance = path.parameters["conductance"]
low, high = conductance.interval90
assert findings.verdict == "explained" and path.mechanism == "heat_bridge" and path.probability > 0.8
assert low < 0.003 < high and abs(conductance.value - 0.003) < 0.0003  # W/K: 3 mW/K made the recordings
rms = findings.fit.left_out_rms
assert rms.before["temperature2_K"] > 5 * rms.after["temperature2_K"]
print(path.statement)

run = found.tables["series"].query("channel == 'temperature2' and batch == 'run4'")
with picture(__file__, "Sensor at heater 2: recorded less simulated", xlabel="minutes", ylabel="misfit, K") as ax:
    ax.plot(run.time_s / 60, run.recorded - run.before, color=WARM, label="without a path between the heaters")
    ax.plot(run.time_s / 60, run.recorded - run.after, color=COLD, label="with the path that was found")
