"""Why does leave-batch-out flatter a model?

Through a year a shop turns faster and faster. With one run left out at a time the model learns from the later, faster
runs as well; forward, as in use, it knows the past alone. On the same runs the error forward is much larger.
"""

import tempfile
from pathlib import Path

import numpy as np

import thermodrift as td
from docs.gallery.drawing import COLD, WARM, picture

MACHINE = Path(__file__).parents[2] / "machines" / "sample_vmc.yml"
INPUTS = ("rear", "column_front", "bed", "room")
PLAN = """
step: 5 min
stages: [{{minutes: 10, spindle_rpm: 0}}, {{hours: 3, spindle_rpm: {rpm}}}, {{hours: 1, spindle_rpm: 0}}]
surroundings: {{room: {{start: {room} degC, drift: 0.5 K/h}}}}
"""
N = 20

with tempfile.TemporaryDirectory() as folder:
    runs = []
    for k in range(N):
        plan = Path(folder) / f"run{k}.yml"
        room_degC = 18 - 8 * np.cos(2 * np.pi * k / N)
        plan.write_text(PLAN.format(rpm=1500 + 225 * k, room=round(room_degC, 1)))
        runs.append(td.simulate(MACHINE, plan, noise=True, seed=k).batch)


def S_um(train, test):
    """What a random forest of the training runs leaves of the z error of a run, as a standard deviation."""
    model = td.FAMILIES["random_forest"]().fit(train, INPUTS, "z")
    return np.std(test.values("z") - test.values("z")[0] - model.predict(test))


later = range(6, N - 1)
forward_um = np.array([S_um(runs[:k], runs[k]) for k in later])
left_out_um = np.array([S_um(runs[:k] + runs[k + 1 :], runs[k]) for k in later])
print(f"the same {len(later)} runs: forward {forward_um.mean():.2f} µm, leave-batch-out {left_out_um.mean():.2f} µm")
assert forward_um.mean() > 1.15 * left_out_um.mean()
assert forward_um[-4:].mean() > 1.3 * left_out_um[-4:].mean()  # the faster, the less the past helps

rpm = [1500 + 225 * k for k in later]
labels = {"xlabel": "spindle speed of the run, 1/min", "ylabel": "S of the z error, µm"}
with picture(__file__, "One model, the same runs, two ways to examine it", **labels) as ax:
    ax.plot(rpm, forward_um, "o-", color=WARM, label="forward: learned from slower, earlier runs")
    ax.plot(rpm, left_out_um, "o-", color=COLD, label="leave-batch-out: learned from all others")
    ax.set_ylim(0, None)
